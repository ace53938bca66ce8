"""The experiments of the paper: what is run, the tables and figures, the published numbers."""
