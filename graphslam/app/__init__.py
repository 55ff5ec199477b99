"""Storey 6: pipeline, run folder, verbs and the command line."""
