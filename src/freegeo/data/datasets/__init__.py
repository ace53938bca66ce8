"""The datasets of the benchmark: the contract (`base`), one file for each, and their list (`registry`)."""
