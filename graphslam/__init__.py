"""graphslam: globally consistent maps with an uncertainty you can trust.

The verbs (``load``, ``run``, ``compare``, ``simulate`` …) are looked up lazily, so that ``import graphslam`` costs
nothing heavy and never imports gtsam, Open3D or matplotlib.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

# verb -> module that holds it. None may bear the name of a subpackage: importing that would take its place.
_VERBS = {
    "load": "graphslam.app.verbs",
    "run": "graphslam.app.verbs",
    "compare": "graphslam.app.verbs",
    "join_submaps": "graphslam.app.verbs",
    "local_maps": "graphslam.app.verbs",
    "merge": "graphslam.app.sessions.merge",
    "localise": "graphslam.app.sessions.localise",
    "export": "graphslam.app.export",
    "solve_file": "graphslam.app.verbs",
    "simulate": "graphslam.app.verbs",
    "open_run": "graphslam.app.verbs",
    "study": "graphslam.app.verbs",
    "open_study": "graphslam.app.verbs",
}
# types a notebook makes itself
_TYPES = {
    "EvidenceGrid": "graphslam.evidence.grid",
    "GridPool": "graphslam.evidence.pool",
    "BeamModel": "graphslam.evidence.beams",
}
_NAMES = {**_VERBS, **_TYPES}

__all__ = ["__version__", *_NAMES]


def __getattr__(name: str) -> Any:
    if name in _NAMES:
        return getattr(importlib.import_module(_NAMES[name]), name)
    raise AttributeError(f"module 'graphslam' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
