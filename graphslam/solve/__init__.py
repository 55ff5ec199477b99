"""Storey 3: incremental and batch solvers over graphs and pose networks."""
