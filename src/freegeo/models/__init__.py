"""Models: one contract (`api`), one catalog, and per architecture one module and one of its sizes (`*_config`)."""
