"""Which landmark is which: one search for the graph and for joiners."""
