"""What a solved graph is made of, for ``run.json``: nodes, factors by class, χ² by class with its two-sided bounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from graphslam.evaluate.without_truth import ClassConsistency
from graphslam.graph.pose_graph import PoseGraph


def graph_facts(graph: PoseGraph, classes: Mapping[str, ClassConsistency]) -> dict[str, Any]:
    """JSON-serialisable figures of a graph at its optimum.

    Parameters
    ----------
    graph : PoseGraph
    classes : mapping of str to ClassConsistency
        Of this graph (:func:`graphslam.evaluate.without_truth.class_consistency`).
    """
    return {
        "dim": graph.dim,
        "nodes": len(graph.values.poses),
        "landmarks": len(graph.values.landmarks),
        "submaps": len(graph.submaps),
        "factors": len(graph.records),
        "classes": [c.as_row() for c in classes.values()],
    }
