"""Our own studies, one folder each."""
