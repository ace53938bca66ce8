"""The datasets of the benchmark: one file per dataset, one registry."""
