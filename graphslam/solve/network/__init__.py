"""Pose networks from files: initialisation, solvers, robust solvers, certificates."""
