"""Two front ends on one log: landmark submaps and dense submaps in one chain of one graph."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.folders.generations import current_outputs
from graphslam.app.run.files import read_options
from graphslam.app.run.front_ends import make_front_end
from graphslam.backend.back_end import Observer
from graphslam.core.errors import ConfigError
from graphslam.graph.ledger import EXCLUSIVE
from graphslam_frontends.mixed import SHORTEST
from tests.reference.mixed_log import mixed_log

BOTH = ["segslam", "rbpf-ekf"]
SEGMENTS = {"min_length": 8.0, "min_seconds": 8.0, "max_length": 14.0}
CONFIG = {
    "frontend": {
        "segslam": {
            "steps": {"period": "none"},
            "filter": {"particles": 8, "voxel_size": 0.1},
            "segslam": {"segmentation": SEGMENTS},
        },
        "rbpf-ekf": {"particles": 10, "stopping": {"max_distance": 12.0}},
    },
    "gps": {"use": "all", "baseline": 15.0},
    "backend": {"loops": True},
    "calibrate": {"use": "none"},
}


@pytest.fixture(scope="module")
def log():
    return mixed_log(3, ids=False)


@pytest.fixture(scope="module")
def run(log, tmp_path_factory):
    out = tmp_path_factory.mktemp("mixed") / "run"
    return gs.run(log, frontend=BOTH, config=CONFIG, progress=False, out=out)


def _kinds(run):
    return ["rbpf-ekf" if s.landmarks is not None else "segslam" for s in run.submaps]


def test_both_kinds_stand_in_one_chain(run):
    kinds = _kinds(run)
    assert set(kinds) == set(BOTH)
    assert [s.key for s in run.submaps] == list(range(len(kinds)))
    assert [s.report["front_end"] for s in run.submaps] == kinds
    for a, b in pairwise(run.submaps):
        assert a.interval[1] == pytest.approx(b.interval[0], abs=1e-9)
    for s in run.submaps:  # landmarks outdoors, beams indoors
        assert s.uses == {"controls", "landmarks" if s.landmarks is not None else "laser"}
    assert run.graph.gps_origin is not None
    assert sum(1 for r in run.graph.records.values() if type(r).__name__ == "GpsRecord") == len(run.fixes.times)


def test_no_record_is_used_twice(run):
    spans: dict[str, list[tuple[float, float]]] = {}
    for e in run.graph.ledger.entries():
        if e.kind == EXCLUSIVE:
            spans.setdefault(e.stream, []).append((e.t_start, e.t_end))
    for rows in spans.values():
        rows.sort()
        assert all(b[0] >= a[1] - 1e-9 for a, b in pairwise(rows))
    laser, landmarks = spans["laser"], spans["landmarks"]
    assert not any(a < d and c < b for a, b in laser for c, d in landmarks)
    left = run.report["records_dropped"]
    assert (
        left["laser: scans in intervals mapped by rbpf-ekf"] + left["landmarks: scans in intervals mapped by segslam"]
    )


def test_landmarks_that_return_are_the_same(run, log):
    """Two laps: trees seen in the first one are those of the second one, over dense submaps in between."""
    later = [s for s in run.submaps if s.landmarks is not None and s.interval[0] > 0.6 * log.duration]
    first = {int(i) for s in run.submaps if s.interval[1] < 0.6 * log.duration and s.landmarks for i in s.landmarks.ids}
    again = [int(i) in first for s in later for i in s.landmarks.ids]
    assert np.mean(again) > 0.9
    assert len(run.map.landmarks) == 30


def test_layers_of_both_kinds(run):
    assert run.fused is not None
    assert run.fused.fused.known_volume() > 200.0
    assert run.metric("map_contradicted") == 0.0
    assert len(run.map.landmark_covariances) == 30
    share = next(f for f in run.verdict if f.code == "front-ends")
    assert "rbpf-ekf (controls, landmarks) 0.0 to" in share.text
    assert "segslam (controls, laser)" in share.text


def test_covariances_are_those_of_the_errors():
    """Over three logs NEES of the nodes is what chance allows."""
    quick = {**CONFIG, "backend": {"associate": False}, "map": {"fuse": False}, "gps": {"use": "none"}}
    quick = {**quick, "frontend": {**CONFIG["frontend"], "rbpf-ekf": {"association": "known", "particles": 5}}}
    nees = dof = 0.0
    for seed in (11, 12, 13):
        made = gs.run(mixed_log(seed, laps=1.1), frontend=BOTH, config=quick, progress=False)
        nees, dof = nees + made.metric("nees"), dof + made.metric("nees_dof")
    assert 0.6 < nees / dof < 1.5


def test_a_resumed_run_is_the_run_that_was_never_stopped(run, log, tmp_path):
    stop = next(k for k, s in enumerate(run.submaps) if s.landmarks is None) + 2  # inside an interval of segslam

    class Stop(Exception):
        pass

    class Stopper(Observer):
        added = 0

        def submap_added(self, submap, graph):
            Stopper.added += 1
            if Stopper.added == stop:
                raise Stop

    with pytest.raises(Stop):
        gs.run(log, frontend=BOTH, config=CONFIG, progress=[Stopper()], out=tmp_path / "run")
    again = gs.run(log, frontend=BOTH, config=CONFIG, progress=False, out=tmp_path / "run", resume=True)
    assert again.report["resumed_submaps"] == stop
    a, b = (current_outputs(p) / "metrics.json" for p in (run.folder, tmp_path / "run"))
    assert a.read_bytes() == b.read_bytes()


def test_the_folder_holds_the_run(run):
    assert read_options(run.folder)["run"]["frontend"] == BOTH
    opened = gs.open_run(run.folder)
    assert opened.headline == run.headline
    assert opened.solution.objective == pytest.approx(run.solution.objective, abs=1e-9)


def test_intervals_follow_the_log(log):
    front = make_front_end(BOTH, CONFIG["frontend"])
    found = front.intervals(log)
    assert [i.landmarks for i in found] == [True, False, True, False, True]
    assert all(i.end - i.begin >= SHORTEST - 1.0 for i in found[1:-1])
    assert [i.end for i in found[:-1]] == [i.begin for i in found[1:]]


def test_what_does_not_go_together_is_refused(log):
    clouds = gs.PointClouds.from_arrays([0.0, 0.1], np.ones((5, 3)), [0, 2, 5])
    space = replace(log, streams={**log.streams, "clouds": clouds})
    with pytest.raises(
        ConfigError, match=r"two dimensions.*rbpf-ekf maps in the plane, segslam maps 'clouds' in space"
    ):
        gs.run(space, frontend=BOTH, config=CONFIG, progress=False)
    with pytest.raises(ConfigError, match="segslam, rbpf-grid cannot share a log"):
        gs.run(log, frontend=["segslam", "rbpf-grid"], progress=False)
    with pytest.raises(ConfigError, match=r"frontend.particles: this run .* options in frontend.segslam or"):
        gs.run(log, frontend=BOTH, config={"frontend": {"particles": 3}}, progress=False)
    with pytest.raises(ConfigError, match="each once"):
        gs.run(log, frontend=["segslam", "segslam"], progress=False)


def test_a_folder_gives_back_every_factor(tmp_path):
    """Both kinds of submaps, GPS, IMU and sensor biases: the graph of the folder has the objective of the run."""
    options = {
        "preset": "none",
        "frontend": {
            "segslam": {"steps": {"period": "none", "motion": ["wheels"]}, "filter": {"particles": 8}},
            "rbpf-ekf": {"particles": 10},
        },
        "imu": {"use": "auto"},
        "gps": {"use": "all"},
        "calibrate": {"given": {"distance_scale": 1.002}},  # then the graph estimates what is left of them
    }
    world = gs.simulate("mixed", seed=2, preset="quick")
    made = gs.run(world, frontend=BOTH, config=options, progress=False, out=tmp_path / "run")
    opened = gs.open_run(tmp_path / "run")
    kinds = [Counter(type(r).__name__ for r in g.records.values()) for g in (made.graph, opened.graph)]
    assert kinds[0] == kinds[1]
    assert {"BetweenRecord", "GpsRecord", "ImuRecord", "SensorBiasRecord", "SubmapRecord"} <= set(kinds[0])
    assert opened.solution.objective == pytest.approx(made.solution.objective, abs=1e-9)
    assert made.graph.objective().total == pytest.approx(made.solution.objective, abs=1e-9)
