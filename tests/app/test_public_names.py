"""What ``import graphslam as gs`` offers: the verbs, the types a notebook needs, lists of choices; and nothing else."""

from __future__ import annotations

import inspect

import pytest

import graphslam as gs
from graphslam.app.run.front_ends import make_front_end
from graphslam.core.records import Stream
from graphslam.graph.factor_graph import FactorGraph
from graphslam.solve.registry import make_solver

VERBS = {
    *("compare", "export", "find_loops", "find_study", "first_particles", "join_submaps", "load", "local_maps"),
    *("localise", "merge", "open_run", "open_study", "refine_path", "run", "simulate", "solve_file", "study"),
    *("calibrate_log", "relax_skeleton", "solve_graph", "to_open3d"),
}
LISTS = {"front_ends", "joiners", "options", "solvers", "worlds"}
STREAMS = {
    *("Gps", "Imu", "LandmarkObservations", "LaserScans", "Odometry", "PointClouds", "PointObservations", "RangeScans"),
    *("SteeringControls", "VelocityControls"),
}
TYPES = {
    *("Collapse", "EvidenceUse", "FactorGraph", "Run", "SensorLog", "SkeletonProblem", "Slam", "Submap", "Trajectory")
}


def test_tab_completion_offers_these_and_no_more() -> None:
    assert set(dir(gs)) == VERBS | LISTS | STREAMS | TYPES | {"plots", "__version__"}
    with pytest.raises(AttributeError, match="GridPool"):
        _ = gs.GridPool


@pytest.mark.parametrize("name", sorted(VERBS | LISTS | TYPES))
def test_help_teaches(name: str) -> None:
    """A first sentence, what goes in, and a short example."""
    doc = inspect.getdoc(getattr(gs, name)) or ""
    if name == "FactorGraph":  # in its module
        doc += inspect.getmodule(gs.FactorGraph).__doc__ or ""  # type: ignore[union-attr]
    assert doc.split("\n")[0].rstrip().endswith((".", ":"))
    assert "Examples\n--------" in doc
    if name in VERBS:
        assert "Parameters\n----------" in doc


@pytest.mark.parametrize("name", sorted(STREAMS))
def test_streams_say_their_fields(name: str) -> None:
    kind = getattr(gs, name)
    assert "Parameters\n----------" in (inspect.getdoc(kind) or "")
    assert {"times", "take"} <= set(dir(kind)) | set(kind.__annotations__)
    assert Stream is not kind


def test_what_is_listed_can_be_used() -> None:
    assert {"segslam", "rbpf-ekf"} <= set(gs.front_ends())
    assert all(make_front_end(name, {}).name == name for name in ("segslam", "rbpf-grid"))
    for name in gs.solvers():
        assert make_solver(name, FactorGraph(2)).graph.dim == 2
    submaps = gs.local_maps(gs.simulate("landmark-field", preset="quick"), options={"particles": 10})[:3]
    for name in gs.joiners():
        assert gs.join_submaps(submaps, name).states > 0
    assert {"garage", "landmark-field"} <= set(gs.worlds())
