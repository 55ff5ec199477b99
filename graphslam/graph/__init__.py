"""Storey 2: nodes, factors and the evidence ledger. The package itself imports no gtsam; its modules do."""
