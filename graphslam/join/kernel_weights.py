"""Replacement of robust kernels by weights, for methods that need Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np

from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import FactorRecord
from graphslam.graph.noise import NO_KERNEL


def without_kernels(graph: FactorGraph) -> tuple[FactorGraph, float]:
    """The graph with weights in place of robust kernels, and the constant to add to its sum of squares."""
    records = list(graph.records.values())
    flat, values = graph.flat(), graph.values
    out = FactorGraph.with_values(values.copy())
    if not flat.has_kernels:
        for r in records:
            out.insert(r)
        return out, 0.0
    for r, d2 in zip(records, flat.squared(values).tolist()):
        kernel = getattr(r, "robust", NO_KERNEL)
        out.insert(r if kernel.kind == "none" else _weighted(r, float(kernel.weight(np.array([d2]))[0])))
    return out, graph.objective().total - out.objective().total


def _weighted(record: Any, weight: float) -> FactorRecord:
    """A factor without its kernel; its information is multiplied by a weight."""
    root = math.sqrt(weight)
    if hasattr(record, "whitener"):
        return cast(FactorRecord, replace(record, whitener=root * record.whitener, robust=NO_KERNEL))
    return cast(FactorRecord, replace(record, sigma=record.sigma / max(root, 1e-150), robust=NO_KERNEL))
