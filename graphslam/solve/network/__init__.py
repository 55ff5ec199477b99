"""Pose networks from files: starts, solvers, robust solvers, certificates."""
