"""The HTML report and the interactive viewer of output folders."""
