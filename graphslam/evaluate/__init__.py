"""Storey 4: consistency (NEES, CI) and trajectory errors."""
