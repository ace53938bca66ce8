"""Models: one contract (`api`), one catalog, one file per architecture."""
