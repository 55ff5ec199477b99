"""Several sessions in one map: continue, merge, localise."""
