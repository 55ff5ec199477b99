"""Runs of dense submaps in space merged by places and by GPS, localised in, and gone on with."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from typer.testing import CliRunner

import graphslam
from graphslam.app.cli import app
from graphslam.app.folders.generations import current_outputs
from graphslam.app.run import options as run_options
from graphslam.app.run import pipeline
from graphslam.app.run.outputs import read_run_folder
from graphslam.app.run.surface import scanned_path
from graphslam.app.sessions.dense import session_of
from graphslam.app.sessions.localise import localise
from graphslam.app.sessions.merge_surface import surface_of_sessions
from graphslam.backend.sessions import add_session, connect_session
from graphslam.core import se3
from graphslam.core.atomic import read_npz
from graphslam.core.errors import ConfigError, DataError, RunFolderError, SolverError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog, Truth
from graphslam.core.point_clouds import PointClouds
from graphslam.core.records import Gps
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.ledger import EvidenceUse
from graphslam.loops.inter_session_loops import InterSessionConfig, TwoSessions
from graphslam.maps.surface.piece import SurfaceConfig
from graphslam.solve.registry import make_solver
from graphslam_frontends.base import FrontEnd
from tests.pictures import full_pictures
from tests.reference.box_submaps import straight_path
from tests.reference.box_world import corridor, hall
from tests.reference.hall_sessions import HallDrive, hall_drive

CHI2_6 = 22.5  # 99.9 %
T_GPS_WORLD = np.array([50.0, 20.0, 5.0, 0.0, 0.0, np.sin(0.5), np.cos(0.5)])


@dataclass(frozen=True)
class NoOptions:
    """A front end without any."""


@dataclass(frozen=True)
class Ready(FrontEnd):
    """Hands over what was made beforehand."""

    made: tuple[Submap, ...]
    config: NoOptions = NoOptions()
    name: str = "ready"

    def submaps(self, log: SensorLog, *, after: Submap | None = None, **_: Any) -> Iterator[Submap]:
        return iter(s for s in self.made if after is None or s.key > after.key)


def log_of(d: HallDrive, name: str, seed: int) -> SensorLog:
    """Truth in the frame of the first pose, that frame in the hall's, and GPS of 5 cm that both share."""
    frame, rng = d.path.poses[0], np.random.default_rng(seed)
    fine = np.linspace(d.path.times[0], d.path.times[-1], 10 * len(d.path) - 9)  # a path with holes is no truth
    poses = d.path.interpolate(fine)
    own = Trajectory(fine, se3.se3_between(np.broadcast_to(frame, poses.shape), poses))
    z = se3.se3_transform(np.broadcast_to(T_GPS_WORLD, d.path.poses.shape), d.path.positions)
    z = z + 0.05 * rng.standard_normal(z.shape)
    gps = Gps(times=d.path.times, positions=z, sigma=np.full(len(z), 0.05), lever=np.zeros(3))
    truth = Truth(own, landmark_ids=np.zeros(0, dtype=np.int64), landmarks=np.zeros((0, 3)))
    seen = {} if any(m.cloud is None for m in d.submaps) else {"scanner": scans_of(d)}
    return SensorLog(name=name, streams={"gps": gps, **seen}, truth=truth, meta={"T_world_frame": frame.tolist()})


def scans_of(d: HallDrive) -> PointClouds:
    """The scans that the clouds of a drive were made of, each in its own frame."""
    times, points = [], []
    for m in d.submaps:
        assert m.cloud is not None
        assert m.trajectory is not None
        for k in range(int(m.cloud.scan.max()) + 1):
            own = se3.se3_inverse(m.trajectory.poses[k])
            times.append(float(m.trajectory.times[k]))
            points.append(se3.se3_transform(own, m.cloud.points[m.cloud.scan == k]))
    first = np.unique(times, return_index=True)[1]  # two submaps share the scan at their border
    points = [points[k] for k in first]
    return PointClouds.from_arrays(np.array(times)[first], np.concatenate(points), np.cumsum([0, *map(len, points)]))


def scanned_from(logs: list[tuple[Any, SensorLog]]) -> Any:
    """`scanned_path` of runs whose logs are in memory."""
    known = {str(run.folder): log for run, log in logs}
    return lambda run, log=None: scanned_path(run, log=log or known[str(run.folder)])


def solved(d: HallDrive, name: str, out: Path, *, gps: str = "none", seed: int = 0) -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_options, "make_front_end", lambda *_: Ready(tuple(d.submaps)))
        patch.setattr(run_options, "recommended_options", lambda *_: {})
        config = {"gps": {"use": gps, "robust": "none"}}
        return pipeline.run(log_of(d, name, seed), frontend="ready", out=out, config=config, progress=False)


@pytest.fixture(scope="module")
def drives() -> list[HallDrive]:
    world, rng = hall(cars=60), np.random.default_rng(3)
    return [
        hall_drive(world, straight_path(8.0, 44.0, 8.0, step=0.75), rng),
        hall_drive(world, straight_path(50.0, 16.0, 9.0, yaw=np.pi, step=0.75), rng),
    ]


@pytest.fixture(scope="module")
def runs(drives: list[HallDrive], tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    root = tmp_path_factory.mktemp("dense")
    return [solved(d, name, root / name) for d, name in zip(drives, ("there", "back"))]


@pytest.fixture(scope="module")
def merged(runs: list[Any]) -> Any:
    return graphslam.merge([r.folder for r in runs])


def truth_between(drives: list[HallDrive]) -> Array:
    return se3.se3_between(drives[0].path.poses[0], drives[1].path.poses[0])


def test_two_drives_become_one_map(drives: list[HallDrive], merged: Any) -> None:
    assert merged.metric("sessions") == 2
    assert merged.metric("converged") == 1
    assert merged.metric("back_ties") >= 2  # one of each stretch
    s = merged.sessions[1]
    e = se3.se3_log(se3.se3_between(s.T_world_base, truth_between(drives)))
    assert e @ np.linalg.solve(s.covariance, e) < CHI2_6
    assert np.linalg.norm(e[3:]) < 0.5
    assert merged.metric("back_base_error") == pytest.approx(np.linalg.norm(e[3:]), abs=1e-6)
    assert 0.0 < merged.metric("path_rmse_aligned") < 0.2
    # on its own clock, in the common frame
    assert s.trajectory.times[0] == drives[1].path.times[0]
    assert len(s.trajectory) == len(drives[1].path)
    np.testing.assert_allclose(s.trajectory.poses[0], s.T_world_base, atol=1e-9)
    # no stream of the one was taken for one of the other
    streams = set(merged.graph.ledger.table()["stream"])
    assert {"there/scanner", "back/scanner"} <= streams


def test_drives_of_clouds_become_one_map(tmp_path: Path) -> None:
    world, rng = hall(cars=60), np.random.default_rng(3)
    paths = straight_path(8.0, 44.0, 8.0, step=0.75), straight_path(50.0, 16.0, 9.0, yaw=np.pi, step=0.75)
    drives = [hall_drive(world, path, rng, clouds=True) for path in paths]
    runs = [solved(d, name, tmp_path / name) for d, name in zip(drives, ("there", "back"))]
    assert (tmp_path / "there" / "cloud.ply").is_file()
    m = graphslam.merge([r.folder for r in runs])
    s = m.sessions[1]
    e = se3.se3_log(se3.se3_between(s.T_world_base, truth_between(drives)))
    assert e @ np.linalg.solve(s.covariance, e) < CHI2_6
    assert np.linalg.norm(e[3:]) < 0.5
    # the surface of both in one frame: walls of the two lie on each other
    logs = [log_of(d, n, 0) for n, d in zip(("there", "back"), drives)]
    found = surface_of_sessions(m, logs=logs, config=SurfaceConfig(voxel=0.3), progress=False)
    assert found.facts()["sessions"] == 2
    assert all(np.count_nonzero(found.session == k) > 500 for k in (0, 1))
    assert np.isfinite(found.sigma[found.session >= 0]).all()
    one, other = (found.mesh.vertices[found.session == k] for k in (0, 1))
    near = cKDTree(one).query(other)[0]
    assert np.mean(near < 0.6) > 0.1  # they drove through the same part of the hall
    with pytest.raises(ConfigError, match="1 logs of 2 sessions"):
        surface_of_sessions(m, logs=logs[:1])
    # written with the merge, if asked for
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("graphslam.app.sessions.merge_surface.scanned_path", scanned_from(list(zip(runs, logs))))
        graphslam.merge(runs, out=tmp_path / "both", surface=SurfaceConfig(voxel=0.3))
    facts = json.loads((current_outputs(tmp_path / "both") / "surface.json").read_text())
    assert facts["sessions"] == 2
    assert facts["colour"] == "session"
    assert (current_outputs(tmp_path / "both") / "figures" / "surface_sessions.png").is_file()
    with pytest.raises(ConfigError, match="taste"):
        graphslam.merge(runs, out=tmp_path / "third", surface=SurfaceConfig(), colour="taste")


def test_isam2_comes_to_the_same_optimum(runs: list[Any], merged: Any) -> None:
    other = graphslam.merge([r.folder for r in runs], solver="isam2")
    assert other.metric("objective") == pytest.approx(merged.metric("objective"), rel=1e-6)
    np.testing.assert_allclose(other.solution.poses, merged.solution.poses, atol=1e-5)


def test_the_runs_own_ties_come_along(runs: list[Any], tmp_path: Path) -> None:
    """A loop of a run's graph is in the merged graph, from the graph in memory and from the file."""
    graph = runs[0].graph
    T, P = np.array([0.0, 0, 0, 0, 0, 0, 1]), 1e-2 * np.eye(6)
    n = len(graph.values.poses)
    T = se3.se3_between(graph.values.poses[2], graph.values.poses[n - 2])
    fid = graph.add_between(2, n - 2, T, P, evidence=EvidenceUse(["scanner"], (0.0, 0.0), "shared-scan"), group="loop")
    try:
        m = graphslam.merge([runs[0], runs[1]])
        own = [r for r in m.graph.records.values() if isinstance(r, BetweenRecord) and r.group == "match"]
        assert [(r.i, r.j) for r in own] == [(2, n - 2)]
        np.testing.assert_allclose(np.linalg.inv(own[0].whitener.T @ own[0].whitener), P, rtol=1e-9)
    finally:
        graph.remove(fid)


def test_gps_ties_what_was_never_seen_twice(tmp_path: Path) -> None:
    """Two halls that are not one; their fixes are in one frame. Without GPS they do not hang together."""
    rng = np.random.default_rng(8)
    a = hall_drive(hall(cars=60), straight_path(8.0, 35.0, 8.0, step=0.75), rng)
    path = straight_path(-15.0, 12.0, 0.0, step=0.75)
    b = hall_drive(corridor(120.0), path, rng)
    moved = np.array([80.0, 30.0, 0.0, 0.0, 0.0, np.sin(0.4), np.cos(0.4)])
    b = HallDrive(b.submaps, b.path.transformed(moved))
    pair = [solved(d, n, tmp_path / n, gps="all", seed=k) for k, (d, n) in enumerate([(a, "hall"), (b, "corridor")])]
    m = graphslam.merge([r.folder for r in pair])
    s = m.sessions[1]
    e = se3.se3_log(se3.se3_between(s.T_world_base, truth_between([a, b])))
    # roll of a straight drive is known by the path alone: position and heading are what fixes say
    k = [2, 3, 4]
    assert e[k] @ np.linalg.solve(s.covariance[np.ix_(k, k)], e[k]) < 16.3
    assert np.linalg.norm(e[3:5]) < 0.5
    assert m.metric("corridor_ties") == 0
    assert m.solution.score["gps"].factors == len(a.path) + len(b.path)
    with pytest.raises(DataError, match=r"corridor: cannot be merged .* no link to hall: .* looked alike"):
        graphslam.merge(pair, by="places")
    bare = replace(pair[1], fixes=None)
    with pytest.raises(DataError, match=r"corridor: cannot be merged .* no link to hall"):
        graphslam.merge([pair[0], bare])
    with pytest.raises(DataError, match="no GPS"):
        graphslam.merge([pair[0], bare], by="gps")


def test_a_submap_is_found_in_a_saved_map(drives: list[HallDrive], runs: list[Any]) -> None:
    found = localise(runs[0].folder, drives[1].submaps)
    assert found.found
    assert found.T_map_base is not None
    assert found.T_map_end is not None
    e = se3.se3_log(se3.se3_between(found.T_map_base, truth_between(drives)))
    assert e @ np.linalg.solve(found.covariance, e) < CHI2_6
    end = se3.se3_between(drives[0].path.poses[0], drives[1].path.poses[-1])
    e = se3.se3_log(se3.se3_between(found.T_map_end, end))
    assert e @ np.linalg.solve(found.end_covariance, e) < CHI2_6
    assert any(not r["accepted"] for r in found.rows())
    assert all(r["why"] for r in found.rows())
    stranger = hall_drive(corridor(120.0), straight_path(-12.0, 12.0, 0.0, step=0.75), np.random.default_rng(4))
    lost = localise(runs[0], stranger.submaps[0])
    assert not lost.found
    assert "looked alike" in lost.why
    assert lost.T_map_base is None


def test_what_cannot_be_merged_is_refused(runs: list[Any], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="places, gps"):
        graphslam.merge(runs, by="identity")
    no_grids = replace(runs[1], folder=None, submaps=[replace(s, grid=None) for s in runs[1].submaps])
    with pytest.raises(DataError, match="have no map"):
        graphslam.merge([runs[0], no_grids])


def test_places_that_ties_bring_near_each_other_have_a_say(runs: list[Any]) -> None:
    """Ties that agree, all of them 9 m off: what is brought near each other by them does not match."""
    known, new = (session_of(r, name, first_key=10 * k, after=1e4 * k) for k, (r, name) in enumerate(zip(runs, "ab")))
    two = TwoSessions(known.map, new.map)
    found = two.find(InterSessionConfig())
    shift = np.array([-9.0, 0.3, 0.0, 0.0, 0.0, 0.0, 1.0])  # the first drive goes straight on
    wrong = replace(found, loops=tuple(replace(x, T_ij=se3.se3_compose(shift, x.T_ij)) for x in found.loops))
    for loops, named in ((wrong, r"b: \d+ loop closures with a agree .* looks alike"), (found, "")):
        graph = FactorGraph(3)
        solver = make_solver("batch", graph)
        add_session(graph, known)
        solver.solve_to_optimum()
        if named:
            with pytest.raises(SolverError, match=named):
                connect_session(graph, solver, known, 0, new, found=(two, loops), config=InterSessionConfig(heard=1))
        else:
            assert len(connect_session(graph, solver, known, 0, new, found=(two, loops)).used) >= 2


def test_command_lines(drives: list[HallDrive], runs: list[Any], tmp_path: Path) -> None:
    out = tmp_path / "both"
    folders = [str(r.folder) for r in runs]
    with full_pictures():
        done = CliRunner().invoke(app, ["merge", *folders, "--out", str(out), "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    assert {m["key"]: m["value"] for m in json.loads(done.stdout)["metrics"]}["sessions"] == 2
    a = read_npz(out / "merged.npz", fmt="graphslam.merged-submaps/1")
    assert a["bases"].shape == (len(a["keys"]), 7)
    assert (out / "figures" / "map.png").stat().st_size > 5000
    assert (out / "trajectory_back.tum").is_file()
    candidates = json.loads((out / "merge.json").read_text())["sessions"][1]["candidates"]
    assert sum(c["accepted"] for c in candidates) >= 3
    with pytest.raises(RunFolderError, match="not empty"):
        graphslam.merge(runs, out=out)
    arguments = ["localise", folders[0], folders[1], "--submap", "0", "--json"]
    done = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert done.exit_code == 0
    value = json.loads(done.stdout)
    assert isinstance(value["found"], bool)
    assert len(value["candidates"]) > 0


def test_a_run_goes_on_in_a_saved_map(drives: list[HallDrive], runs: list[Any], tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_options, "make_front_end", lambda *_: Ready(tuple(drives[1].submaps)))
        patch.setattr(run_options, "recommended_options", lambda *_: {})
        patch.setattr(pipeline, "load", lambda *_, **__: log_of(drives[1], "again", 1))
        patch.setattr(pipeline, "check_names", lambda *_: None)
        arguments = ["run", "again", "--frontend", "ready", "--continue", str(runs[0].folder), "--json"]
        out = tmp_path / "again"
        done = CliRunner().invoke(app, [*arguments, "--out", str(out)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert read_run_folder(out).name == "again"
    a = read_npz(out / "continued" / "merged.npz", fmt="graphslam.merged-submaps/1")
    assert a["sessions"].tolist() == ["there", "again"]
    assert json.loads(done.stdout)["continued"]["sessions"][1]["hangs_on"] == "there"
