"""Scores of poses, depth and points: pure functions."""
