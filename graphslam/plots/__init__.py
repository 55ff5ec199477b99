"""Storey 5: data in, Axes out."""
