"""Dense submaps in space through the whole pipeline: a front end that hands over a ring driven twice, with GPS."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from graphslam.app.run import options as run_options
from graphslam.app.run import pipeline
from graphslam.app.run.outputs import read_run_folder
from graphslam.core.errors import ConfigError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.geometry import se2_between, se2_log
from graphslam.core.log import SensorLog, Truth
from graphslam.core.plan_view import plan_covariance, plan_pose
from graphslam.core.poses import SE2, SE3
from graphslam.core.records import Gps, Odometry
from graphslam.core.submap import Match, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.graph.factors.gps import level_datum_pose
from graphslam.io.g2o import read_g2o
from graphslam_frontends.base import FrontEnd
from tests.pictures import full_pictures
from tests.reference.space_chain import dense_chain

GROUP = {2: SE2, 3: SE3}
SIGMA = {2: np.array([0.02, 0.02, 5e-3]), 3: np.array([2e-3, 2e-3, 5e-3, 0.02, 0.02, 0.02])}


@dataclass(frozen=True)
class NoOptions:
    """A front end without any."""


@dataclass(frozen=True)
class Ring(FrontEnd):
    """Hands over what was made beforehand."""

    made: tuple[Submap, ...]
    config: NoOptions = NoOptions()
    name: str = "ring"

    def submaps(self, log: SensorLog, *, after: Submap | None = None, **_: Any) -> Iterator[Submap]:
        return iter(s for s in self.made if after is None or s.key > after.key)


def ring(dim: int, seed: int = 4) -> tuple[SensorLog, Ring]:
    """Log with truth and GPS, and the front end; every submap of the second lap was matched, one of them vaguely."""
    rng, group = np.random.default_rng(seed), GROUP[dim]
    chain = dense_chain(rng, dim, m=8, steps=40, laps=2.0)
    made = []
    for k, s in enumerate(chain.submaps):
        matches = ()
        if k >= 4:
            error = group.exp(SIGMA[dim] * rng.standard_normal(group.dof))
            T = group.compose(group.between(chain.poses[k - 4], chain.poses[k]), error)
            support = 0.1 if k == 6 else 0.9
            P = np.diag(SIGMA[dim] ** 2)
            matches = (Match(target=k - 4, T_target_here=T, covariance=P, fitness=0.95, support=support),)
        made.append(replace(s, matches=matches, report={"ended": "test", "scans": 40}))
    times = np.concatenate([t[:-1] for t in chain.times] + [chain.times[-1][-1:]])
    poses = np.concatenate([p[:-1] for p in chain.path] + [chain.path[-1][-1:]])
    T = level_datum_pose(np.array([50.0, 20.0, 5.0, 1.0])) if dim == 3 else np.array([50.0, 20.0, 1.0])
    z = group.transform(T, poses[::3, :dim]) + 0.3 * rng.standard_normal((len(poses[::3]), dim))
    gps = Gps(times=times[::3], positions=z, sigma=np.full(len(z), 0.3), lever=np.zeros(dim))
    path = Trajectory(times, poses)
    landmarks = {"landmark_ids": np.zeros(0, dtype=np.int64), "landmarks": np.zeros((0, dim))}
    steps = np.concatenate([group.identity[None], group.between(poses[:-1], poses[1:])])
    odometry = Odometry(
        times=times, increments=steps, covariances=np.tile(1e-4 * np.eye(group.dof), (len(steps), 1, 1))
    )
    log = SensorLog(name="ring", streams={"gps": gps, "odometry": odometry}, truth=Truth(path, **landmarks))
    return log, Ring(tuple(made))


def solved(dim: int, monkeypatch: pytest.MonkeyPatch, out: Any = None, *, seed: int = 4, **options: Any) -> Any:
    log, front = ring(dim, seed)
    monkeypatch.setattr(run_options, "make_front_end", lambda *_: front)
    monkeypatch.setattr(run_options, "recommended_options", lambda *_: {})
    config = {"gps": {"use": "every-second", "robust": "none"}, **options.pop("config", {})}
    return pipeline.run(log, frontend="ring", out=out, config=config, progress=False, **options)


@pytest.mark.parametrize("dim", [2, 3])
def test_folder_is_complete_and_comes_back(dim, tmp_path, monkeypatch):
    with full_pictures():
        r = solved(dim, monkeypatch, tmp_path / "run")
    names = {p.name for p in (tmp_path / "run").iterdir()}
    wanted = {"trajectory.tum", "nodes.tum", "graph.g2o", "run.json", "metrics.json", "events.jsonl", "map.npz"}
    assert wanted <= names
    figures = {p.name for p in (tmp_path / "run" / "figures").iterdir()}
    assert {"map.png", "submaps.png"} <= figures
    assert ("side.png" in figures) == (dim == 3)
    assert r.metric("converged") == 1.0
    assert r.metric("gap") == pytest.approx(0.0, abs=1e-6)
    assert r.graph.dim == dim
    assert len(r.map.node_poses) == 8 * 7 + 1
    assert len(r.map.base_poses) == 9
    assert len(r.map.trajectory) == 8 * 40 + 1
    assert np.all(np.diff(r.map.node_times) > 0)
    network = read_g2o(tmp_path / "run" / "graph.g2o")
    assert network.dim == dim
    assert len(network.edges) == 8 * 7 + 3
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert [e["support"] for e in events if e["event"] == "match-not-used"] == [0.1]
    assert sum(e.get("group") == "match" for e in events if e["event"] == "between") == 3
    back = read_run_folder(tmp_path / "run")
    np.testing.assert_array_equal(back.map.base_poses, r.map.base_poses)
    np.testing.assert_array_equal(back.map.trajectory.covariances, r.map.trajectory.covariances)
    assert back.truth_path.dim == dim
    # the odometry of this log is exact, so the reckoned path is the true one
    np.testing.assert_allclose(r.dead_reckoning.positions, r.truth_path.positions, atol=1e-6)
    assert back.dead_reckoning.dim == dim


def test_fixes_that_come_too_often_are_withheld(monkeypatch):
    """One in so many seconds is used; all others are withheld and counted."""
    every_second, seldom = (
        solved(2, monkeypatch, config={"gps": {"use": "all", "every": every}}) for every in (0.0, 1.0)
    )
    times = ring(2)[0]["gps"].times
    wanted, last = 0, -np.inf
    for t in times:
        if t - last >= 1.0 - 1e-6:
            wanted, last = wanted + 1, t
    assert 0 < seldom.graph.objective()["gps"].factors <= wanted < len(times)
    assert every_second.graph.objective()["gps"].factors > 1.9 * seldom.graph.objective()["gps"].factors
    assert every_second.checks.gps is None
    assert len(seldom.checks.gps.times) + wanted == len(times)
    with pytest.raises(ConfigError, match=r"gps\.every"):
        solved(2, monkeypatch, config={"gps": {"use": "all", "every": -1.0}})


@pytest.mark.parametrize("dim", [2, 3])
def test_map_is_near_the_truth_and_gps_is_scored(dim, monkeypatch):
    r = solved(dim, monkeypatch)
    assert r.metric("pose_rmse") < 0.35
    assert r.metric("path_rmse_aligned") < 0.25
    assert r.metric("gps_withheld_rmse") < 0.6
    assert 0.5 < r.metric("gps_nis_each_value") < 1.6  # withheld fixes are foretold, and as well as is claimed
    assert r.checks.gps.dim == dim
    assert r.metric("gps_chi2_per_dof") == pytest.approx(1.0, abs=0.5)
    assert r.map.T_gps_world.shape == (GROUP[dim].size,)
    open_ended = solved(dim, monkeypatch, config={"backend": {"match_support": 2.0}, "gps": {"use": "none"}})
    assert "match" not in open_ended.graph.objective()
    assert open_ended.metric("path_rmse_aligned") > r.metric("path_rmse_aligned")


@pytest.mark.parametrize("dim", [2, 3])
def test_covariances_of_maps_are_consistent_over_four_worlds(dim, monkeypatch):
    """All bases of a map together: half or twice the covariance is outside bounds that a consistent one misses once in
    a thousand. By blocks the values of a run are one common error, and count as one draw of χ² each."""
    runs = [solved(dim, monkeypatch, seed=seed) for seed in range(4, 8)]
    assert {r.metric("nees_dof") for r in runs} == {8.0 * GROUP[dim].dof}
    total = 8 * GROUP[dim].dof
    low, high = chi2_mean_bounds(total, len(runs), 0.999)
    assert 0.5 < low / total < high / total < 2.0
    assert low < np.mean([r.metric("nees") for r in runs]) < high
    if dim == 3:
        for block, n in (("position", 3), ("heading", 1), ("level", 2)):
            low, high = chi2_mean_bounds(n, len(runs), 0.99)
            assert low / n < np.mean([r.metric(f"anees_{block}_per_dof") for r in runs]) < high / n


@pytest.mark.parametrize("dim", [2, 3])
def test_solvers_and_resuming_end_at_the_same_map(dim, tmp_path, monkeypatch):
    a = solved(dim, monkeypatch, tmp_path / "a")
    b = solved(dim, monkeypatch, solver="batch")
    np.testing.assert_allclose(a.map.node_poses, b.map.node_poses, atol=1e-5)
    whole = (tmp_path / "a" / "trajectory.tum").read_bytes()
    (tmp_path / "a" / "run.json").unlink()
    for old in (tmp_path / "a" / "submaps").glob("00000[5-7]*"):
        old.unlink()
    resumed = solved(dim, monkeypatch, tmp_path / "a", resume=True)
    assert resumed.report["resumed_submaps"] == 5
    assert (tmp_path / "a" / "trajectory.tum").read_bytes() == whole


def test_levelled_bases_and_no_inner_nodes(monkeypatch):
    r = solved(3, monkeypatch, config={"backend": {"level_sigma": 0.01, "node_spacing": 0.0}})
    assert len(r.map.node_poses) == 9
    assert r.graph.objective()["levelled"].factors == 9
    assert r.graph.values.tilt is not None
    assert r.ledger.query("kind == 'levelled'")["stream"].unique().tolist() == ["gravity"]


def test_a_flat_front_end_takes_the_level_part_of_fixes_in_space(monkeypatch):
    log, _ = ring(3)
    flat, front = ring(2)
    flat = SensorLog(name="ring", streams=log.streams, truth=flat.truth)
    monkeypatch.setattr(run_options, "make_front_end", lambda *_: front)
    monkeypatch.setattr(run_options, "recommended_options", lambda *_: {})
    r = pipeline.run(flat, frontend="ring", config={"gps": {"use": "all"}}, progress=False)
    assert r.graph.dim == 2
    assert r.dead_reckoning.dim == 2
    assert r.graph.objective()["gps"].factors > 50


def test_plan_covariance_against_draws(rng):
    T = SE3.exp([0.02, -0.03, 1.2, 3.0, 2.0, 1.0])
    A = rng.normal(size=(6, 6))
    P = 1e-6 * (A @ A.T + np.eye(6))
    draws = plan_pose(SE3.compose(T, SE3.exp(rng.multivariate_normal(np.zeros(6), P, 40_000))))
    e = se2_log(se2_between(np.broadcast_to(plan_pose(T), draws.shape), draws))
    C = plan_covariance(T, P)
    W = np.linalg.inv(np.linalg.cholesky(C))
    np.testing.assert_allclose(W @ np.cov(e.T) @ W.T, np.eye(3), atol=0.05)


def test_fixes_wait_for_the_baseline_that_is_asked_for(monkeypatch):
    use = {"use": "every-second", "robust": "none"}
    assert solved(2, monkeypatch).map.T_gps_world is not None
    r = solved(2, monkeypatch, config={"gps": {**use, "baseline": 1e4}})
    assert r.map.T_gps_world is None
    (gps,) = [s for s in r.report["streams"] if s["name"] == "gps"]
    assert (gps["used"], "span less than 10000 m" in gps["why"]) == (0, True)
