"""An IMU in a run: used, counted, told by metrics, its axes looked at, also where the front end used it."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from graphslam.app.run import options as run_options
from graphslam.app.run import pipeline
from graphslam.app.run.config import RunConfig
from graphslam.app.worlds import simulate
from graphslam.backend.back_end import Observer
from graphslam.core.config import build_config
from graphslam.core.errors import ConfigError, DataError, EvidenceReusedError, MissingDataError
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import SensorLog, Truth
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from tests.app.run.test_pipeline_space import Ring as HandedOver
from tests.reference.imu_ring import STEP, ring

SWAP = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def misread(imu: Imu) -> Imu:
    return replace(imu, angular_rate=imu.angular_rate @ SWAP.T, specific_force=imu.specific_force @ SWAP.T)


def made(uses: frozenset[str] = frozenset({"laser"})) -> tuple[SensorLog, list[Submap]]:
    rng = np.random.default_rng(5)
    r = ring(rng, submaps=8, step=3 * STEP)
    t = np.arange(0, 481) / 10
    landmarks = {"landmark_ids": np.zeros(0, dtype=np.int64), "landmarks": np.zeros((0, 3))}
    log = SensorLog(name="ring", streams={"imu": r.imu}, truth=Truth(Trajectory(t, r.truth(t)), **landmarks))
    return log, [replace(s, uses=uses, report={"ended": "test", "scans": 12}) for s in r.submaps]


def solved(log: SensorLog, submaps: list[Submap], monkeypatch: pytest.MonkeyPatch, out: Any = None, **options: Any):
    monkeypatch.setattr(run_options, "make_front_end", lambda *_: HandedOver(tuple(submaps)))
    monkeypatch.setattr(run_options, "recommended_options", lambda *_: {})
    return pipeline.run(log, frontend="ring", out=out, progress=options.pop("progress", False), **options)


@pytest.mark.parametrize("solver", ["isam2", "lm", "gnc"])
def test_it_is_used_and_reported(solver, tmp_path, monkeypatch):
    log, submaps = made()
    short = replace(log, streams={"imu": log["imu"].take(log["imu"].times > 1.0)})
    r = solved(short, submaps, monkeypatch, tmp_path / "run", config={"imu": {"use": "auto"}}, solver=solver)
    bare = solved(short, submaps, monkeypatch)
    assert r.metric("converged") == 1.0
    assert r.metric("anees_level_per_dof") < 3
    assert r.metric("path_rmse_aligned") < bare.metric("path_rmse_aligned")
    assert r.metric("imu_gyro_bias") == pytest.approx(8e-3, abs=8e-3)
    assert 0 < r.metric("imu_gyro_bias_sigma") < 5e-3
    assert 0.6 < r.metric("consistency_imu_chi2_per_dof") < 1.6
    assert r.report["records_dropped"]["imu: no factor: before the first reading"] == 1
    assert r.report["imu"]["use"] == "auto"
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    kinds = [e["event"] for e in events]
    assert {"imu", "imu-axes", "imu-bias"} <= set(kinds)
    assert "imu-contradicted" not in kinds
    counts = next(e for e in events if e["event"] == "imu")["dropped"]
    assert counts == {"before the first reading": 1, "gravity outside the readings": 1}
    assert "imu" in set(r.ledger["stream"])
    assert "imu" not in set(bare.ledger["stream"])


FAULTS = {
    "gyro in degrees": (lambda i: replace(i, angular_rate=np.rad2deg(i.angular_rate)), {"imu-contradicted"}),
    "gyro saturated": (
        lambda i: replace(i, angular_rate=np.clip(i.angular_rate, *np.quantile(i.angular_rate, [0.1, 0.9]))),
        {"imu-contradicted", "imu-saturated"},
    ),
    "accelerometer in g": (
        lambda i: replace(i, specific_force=i.specific_force / 9.80665), {"imu-contradicted", "imu-gravity"}
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_an_imu_of_the_graph_that_is_wrong_is_reported(fault, monkeypatch):
    """The front end did not use it, so that nothing but the graph can see that it is wrong."""
    log, submaps = made()
    change, codes = FAULTS[fault]
    r = solved(replace(log, streams={"imu": change(log["imu"])}), submaps, monkeypatch, config={"imu": {"use": "auto"}})
    assert codes <= {f.code for f in r.verdict if f.level == "bad"}
    right = solved(log, submaps, monkeypatch, config={"imu": {"use": "auto"}})
    assert not [f for f in right.verdict if f.level == "bad"]


@pytest.mark.parametrize("every", [0, 5])
def test_a_gap_in_the_readings_is_counted_and_bridged_by_the_submaps(every, monkeypatch):
    """Whenever the factors come in: a node behind the gap waits for its way before it sees gravity."""
    log, submaps = made()
    imu = log["imu"]
    hole = imu.take((imu.times < 20.0) | (imu.times > 26.0))
    config = {"imu": {"use": "auto"}, "backend": {"look_every": every}}
    r = solved(replace(log, streams={"imu": hole}), submaps, monkeypatch, config=config)
    bare = solved(log, submaps, monkeypatch)
    assert not [f for f in r.verdict if f.level == "bad"]
    assert r.metric("path_rmse_aligned") < bare.metric("path_rmse_aligned")
    (event,) = [e for e in r.events if e["event"] == "imu"]
    assert 0 < sum(event["dropped"].values()) < 10
    assert 15 < event["preintegrated"] < 24


def test_what_the_front_end_used_is_not_used_again(monkeypatch):
    log, submaps = made(frozenset({"laser", "imu"}))
    r = solved(log, submaps, monkeypatch, config={"imu": {"use": "auto"}})
    assert not r.graph.sensors["imu"].used
    with pytest.raises(EvidenceReusedError, match=r"'imu' .* a second time: submap 0"):
        solved(log, submaps, monkeypatch, config={"imu": {"use": "imu"}})
    with pytest.raises(MissingDataError, match=r"imu.use names no IMU .* got imu7"):
        solved(log, submaps, monkeypatch, config={"imu": {"use": "imu7"}})


def test_wrong_axes_are_named_while_the_run_goes_on(monkeypatch):
    """Whoever used the readings; with a warning it goes on, ignored it says nothing."""
    log, submaps = made(frozenset({"laser", "imu"}))
    wrong = replace(log, streams={"imu": misread(log["imu"])})
    with pytest.raises(DataError, match=r"imu: the axes .*: x reads −y, y reads x"):
        solved(wrong, submaps, monkeypatch)
    warned = solved(wrong, submaps, monkeypatch, config={"imu": {"axes": "warn"}})
    assert [e["words"] for e in warned.events if e["event"] == "imu-axes"] == ["x reads −y, y reads x"]
    quiet = solved(wrong, submaps, monkeypatch, config={"imu": {"axes": "ignore"}})
    assert not [e for e in quiet.events if e["event"] == "imu-axes"]


def test_a_contradiction_is_reported(monkeypatch, caplog):
    """Submaps that say to be a hundred times as sure as they are."""
    log, submaps = made()
    overconfident = [
        replace(
            s,
            exit_covariance=1e-4 * s.exit_covariance,
            trajectory=replace(s.trajectory, covariances=1e-4 * s.trajectory.covariances),
        )
        for s in submaps
    ]
    r = solved(log, overconfident, monkeypatch, config={"imu": {"use": "auto"}})
    (event,) = [e for e in r.events if e["event"] == "imu-contradicted"]
    assert event["chi2_per_dof"] > event["high"] > 1
    assert "contradict each other" in caplog.text


def test_options_of_the_factors_are_options_of_a_run(monkeypatch):
    log, submaps = made()
    thinned = replace(log, streams={"imu": log["imu"].take(slice(None, None, 3))})
    between = float(np.median(np.diff(thinned["imu"].times)))
    r = solved(thinned, submaps, monkeypatch, config={"imu": {"use": "auto", "pause": 0.5 * between}})
    (event,) = [e for e in r.events if e["event"] == "imu"]
    assert any("pause" in reason for reason in event["dropped"])
    r = solved(thinned, submaps, monkeypatch, config={"imu": {"use": "auto", "pause": 2.0 * between}})
    (event,) = [e for e in r.events if e["event"] == "imu"]
    assert not any("pause" in reason for reason in event["dropped"])


@pytest.mark.parametrize("gravity", [False, True], ids=["planar", "three axes"])
def test_wheels_and_an_imu_in_the_plane(gravity):
    """Landmark submaps from wheels and detections, and an IMU in their graph: consistent, and nearer to the truth."""
    log = simulate("landmark-field", seed=4).slice(0.0, 250.0)
    path, rng = log.truth.trajectory, np.random.default_rng(1)
    t = np.arange(path.times[0], path.times[-1], 0.01)
    along = CubicSpline(path.times, np.column_stack([path.positions, np.unwrap(path.poses[:, 2])]))
    c, s = np.cos(along(t)[:, 2]), np.sin(along(t)[:, 2])
    a, rate = along(t, 2), along(t, 1)[:, 2]
    sigma = np.array([1e-3, 1e-2, 1e-2])
    z = np.column_stack([rate, c * a[:, 0] + s * a[:, 1], c * a[:, 1] - s * a[:, 0]])
    z += np.array([2e-3, -0.02, 0.01]) + 10 * sigma * rng.standard_normal(z.shape)
    noise = ImuNoise(
        gyro=1e-3, gyro_bias=2e-3, gyro_walk=2e-5, accelerometer=1e-2, accelerometer_bias=0.02, accelerometer_walk=1e-4
    )
    none = np.zeros(len(t))
    force = np.column_stack([z[:, 1:], none + 9.81 if gravity else none])
    imu = Imu(times=t, angular_rate=np.column_stack([none, none, z[:, 0]]), specific_force=force, noise=noise)
    both = replace(log, streams={**log.streams, "imu": imu})
    r = pipeline.run(both, frontend="rbpf-ekf", seed=0, progress=False, config={"imu": {"use": "auto"}})
    bare = pipeline.run(both, frontend="rbpf-ekf", seed=0, progress=False)
    (event,) = [e for e in r.events if e["event"] == "imu"]
    assert event["preintegrated"] == len(r.graph.submaps)
    assert not event["dropped"]
    assert r.metric("imu_gyro_bias") == pytest.approx(2e-3, abs=4 * r.metric("imu_gyro_bias_sigma"))
    assert r.metric("imu_gyro_bias_sigma") < 1e-3
    assert r.metric("converged") == 1.0
    assert r.metric("path_rmse_aligned") < 0.9 * bare.metric("path_rmse_aligned")
    assert [f.level for f in r.verdict if f.code == "nees"] == ["good", "good"]
    assert not [f for f in r.verdict if f.level == "bad"]
    assert not [f for f in r.verdict if f.code == "imu-gravity"]


def test_its_options_are_checked():
    for bad in ({"longest": 0.0}, {"axes": "shrug"}, {"robust": "tukey"}, {"acceleration": -1.0}, {"wings": 2}):
        with pytest.raises(ConfigError, match="imu"):
            build_config(RunConfig, {"imu": bad})


def test_a_simulated_robot_is_as_it_is_mounted(tmp_path):
    """SegSLAM on a robot whose IMU it uses: looked at, and nothing is said against it; turned round, it is named."""
    log = simulate_crawler(ring_hall(seed=9), 9, CrawlerConfig(drift=0.08, max_range=8.0))
    options = {"frontend": {"filter": {"particles": 1}}, "map": {"fuse": False}, "refine": {"use": False}}
    r = pipeline.run(log, frontend="segslam", seed=2, config=options, progress=False)
    assert [e["verdict"] for e in r.events if e["event"] == "imu-axes"] == ["as stated"]
    imu = log["imu"]
    flipped = np.diag([1.0, -1.0, -1.0])
    wrong = replace(imu, angular_rate=imu.angular_rate @ flipped, specific_force=imu.specific_force @ flipped)
    with pytest.raises(DataError, match="the axes of the accelerometer are not those that its mounting says"):
        pipeline.run(
            replace(log, streams={**log.streams, "imu": wrong}), frontend="segslam", seed=2, config=options,
            progress=False,
        )  # fmt: skip


@pytest.mark.parametrize("longest", [10.0, 1.0], ids=["ways", "gravity"])
def test_it_enters_while_the_run_goes_on_and_ends_where_it_would(longest, monkeypatch, tmp_path):
    """After every submap, after every third, or at the end: the same factors, and the same optimum."""
    log, submaps = made()
    seen: list[int] = []

    class Count(Observer):
        def submap_added(self, submap: Submap, graph: Any) -> None:
            seen.append(sum(getattr(r, "stream", "") == "imu" for r in graph.records.values()))

    runs = {}
    for every in (0, 3, 1):
        config = {"imu": {"use": "auto", "longest": longest}, "backend": {"look_every": every}}
        seen.clear()
        runs[every] = solved(log, submaps, monkeypatch, config=config, progress=[Count()])
        steps = np.diff([0, *seen])
        assert np.all((steps > 0) == (np.arange(1, 9) % every == 0 if every else np.zeros(8, bool)))

    def kinds(r: Any) -> Counter[Any]:
        return Counter(
            (type(x).__name__, *(v for v in x.variables() if v.startswith("x"))) for x in r.graph.records.values()
        )

    a = runs[0]
    for b in (runs[3], runs[1]):
        assert kinds(b) == kinds(a)
        assert [e for e in b.events if e["event"] == "imu"] == [e for e in a.events if e["event"] == "imu"]
        assert b.solution.objective == pytest.approx(a.solution.objective, rel=1e-4)
        np.testing.assert_allclose(b.map.node_poses, a.map.node_poses, atol=1e-3)
