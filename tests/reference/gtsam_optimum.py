"""GTSAM's own optimum of a graph, as an independent check of ours."""

from __future__ import annotations

import gtsam
import numpy as np

from graphslam.core.errors import SolverError
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import gtsam_factor
from graphslam.graph.gtsam_values import from_gtsam
from graphslam.graph.variables import Values
from tests.reference.gtsam_twin import to_gtsam


def optimise_with_gtsam(graph: FactorGraph, *, max_iterations: int = 100) -> tuple[Values, float]:
    """The same optimum by GTSAM's own Levenberg–Marquardt, as an independent check (ten times slower).

    Returns
    -------
    values : Values
    objective : float
        Twice GTSAM's error, i.e. ``Σ rᵀ P⁻¹ r``.
    """
    factors = gtsam.NonlinearFactorGraph()
    for record in graph.records.values():
        factors.push_back(gtsam_factor(record, {"x0": graph.origin}))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(max_iterations)
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(1e-12)
    optimiser = gtsam.LevenbergMarquardtOptimizer(factors, to_gtsam(graph.values), parameters)
    values = from_gtsam(optimiser.optimize(), graph.values)
    objective = 2.0 * float(factors.error(to_gtsam(values)))
    if not np.isfinite(objective):
        raise SolverError(f"GTSAM ended at objective {objective}")
    return values, objective
