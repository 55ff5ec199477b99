"""graphslam: globally consistent maps with an uncertainty you can trust.

The verbs (``load``, ``run``, ``compare``, ``simulate`` …), the types that a notebook makes or gets, ``plots``, and
lists of what can be chosen (``front_ends()``, ``solvers()``, ``joiners()``, ``worlds()``). All are looked up lazily, so
that ``import graphslam`` costs nothing heavy and never imports gtsam, Open3D or matplotlib.

Examples
--------
The examples of all public names are run by the tests. They take for granted what these lines make:

>>> import numpy as np
>>> import graphslam as gs
>>> log = gs.simulate("landmark-field", preset="quick", seed=1)
>>> run = gs.run(log, out="runs/field", progress=False)
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# name → module that holds it. None may bear the name of a subpackage: importing that would take its place.
_VERBS = {
    "load": "graphslam.app.run.source",
    "simulate": "graphslam.app.worlds",
    "run": "graphslam.app.run.pipeline",
    "calibrate_log": "graphslam.app.run.calibration",
    **dict.fromkeys(("local_maps", "first_particles"), "graphslam.app.run.local_maps"),
    **dict.fromkeys(("study", "open_study", "find_study"), "graphslam.app.studies"),
    **dict.fromkeys(("open_run", "compare", "join_submaps", "refine_path"), "graphslam.app.verbs"),
    "solve_graph": "graphslam.app.verbs",
    "solve_file": "graphslam.app.solve_file",
    "merge": "graphslam.app.sessions.merge",
    "localise": "graphslam.app.sessions.localise",
    **dict.fromkeys(("export", "to_open3d"), "graphslam.app.export"),
    "find_loops": "graphslam.loops.find_loops",
    "relax_skeleton": "graphslam.skeleton.relax",
}
_LISTS = dict.fromkeys(("front_ends", "solvers", "joiners", "worlds", "options"), "graphslam.app.verbs")
_TYPES = {
    "SensorLog": "graphslam.core.log",
    **dict.fromkeys(("LaserScans", "LandmarkObservations", "Odometry", "Gps"), "graphslam.core.records"),
    **dict.fromkeys(("PointObservations", "SteeringControls", "VelocityControls"), "graphslam.core.records"),
    "RangeScans": "graphslam.core.range_scans",
    "PointClouds": "graphslam.core.point_clouds",
    "Imu": "graphslam.core.imu",
    "Submap": "graphslam.core.submap",
    "Trajectory": "graphslam.core.trajectory",
    "FactorGraph": "graphslam.graph.factor_graph",
    "EvidenceUse": "graphslam.graph.ledger",
    "Run": "graphslam.app.run.run",
    "Slam": "graphslam.app.run.slam",
    "Collapse": "graphslam.skeleton.collapse",
    "SkeletonProblem": "graphslam.skeleton.problem",
}
_NAMES = {**_VERBS, **_LISTS, **_TYPES}

# rooms with a face of their own (graphslam.core.lazy_exports): ``gs.plots.plot_scan``
_ROOMS = ("backend", "core", "evaluate", "evidence", "io", "join", "loops", "maps", "plots", "sim")

__all__ = ["__version__", "plots", *_NAMES]


def __getattr__(name: str) -> Any:
    if name in _NAMES:
        return getattr(importlib.import_module(_NAMES[name]), name)
    if name in _ROOMS:
        return importlib.import_module(f"graphslam.{name}")
    raise AttributeError(f"module 'graphslam' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
