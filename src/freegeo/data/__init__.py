"""Scenes and photos: a user's files, the benchmark's datasets, generated rooms."""
