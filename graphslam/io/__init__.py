"""Storey 4: one reader or writer a file format, and the data-set catalogue."""
