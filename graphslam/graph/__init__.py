"""Layer 2: the factor graph: nodes, factors and the evidence ledger. The package itself imports no gtsam."""
