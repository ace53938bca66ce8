"""The published evaluation: pure metrics, frame sampling, scoring of stored predictions."""
