"""Alternative graphs of one run, each solved; the clearest chosen."""
