"""What the photos themselves say about a reconstruction: verified matches, and scores that need no ground truth."""
