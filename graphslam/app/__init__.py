"""Layer 9: pipeline, run folder, commands and the command line."""
