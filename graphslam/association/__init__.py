"""Layer 3: data association of landmarks, for the graph and for map joining."""
