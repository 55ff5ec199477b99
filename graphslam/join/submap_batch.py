"""Batch least squares over landmark submaps, as a solver among solvers.

The work is done in :mod:`graphslam.join.submap_solver`, which the joiners use for their polish, so that "batch" and
"polished" mean one and the same optimum.
"""

from graphslam.join.submap_solver import SubmapEstimate, solve_submaps

__all__ = ["SubmapEstimate", "solve_submaps"]
