"""Bags of a run, read back by ``mcap`` and ``rosbags``: every message type, with the values of the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

import graphslam as gs
from graphslam.app.export import export, map_points
from graphslam.app.export_bag import loop_ends
from graphslam.app.run.run import Run
from graphslam.core import se3
from graphslam.core.errors import OutputError
from graphslam.core.geometry import se2_between, se2_compose, se2_exp
from graphslam.core.se3 import quat_to_matrix
from graphslam.io.bag_writer import ellipsoid, ros_covariances
from tests.reference.map_server import read_map_server

pytest.importorskip("rosbags")
pytest.importorskip("mcap")
TYPES = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/path": "nav_msgs/msg/Path",
    "/markers": "visualization_msgs/msg/MarkerArray",
    "/map": "nav_msgs/msg/OccupancyGrid",
    "/points": "sensor_msgs/msg/PointCloud2",
}
Messages = dict[str, list[tuple[int, Any]]]


def from_mcap(file: Path) -> tuple[Messages, dict[str, str]]:
    """By the reader of mcap; the types are read from the schemas in the file."""
    from mcap.reader import make_reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    out: Messages = {}
    kinds = {}
    with file.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            if channel.topic not in kinds:
                kinds[channel.topic] = schema.name
                types = get_types_from_msg(schema.data.decode(), schema.name)
                store.register({k: v for k, v in types.items() if k not in store.fielddefs})
            made = store.deserialize_cdr(message.data, schema.name)
            out.setdefault(channel.topic, []).append((message.log_time, made))
    return out, kinds


def from_ros2(folder: Path) -> tuple[Messages, dict[str, str]]:
    """By the reader of rosbags."""
    from rosbags.highlevel import AnyReader

    out: Messages = {}
    with AnyReader([folder]) as reader:
        kinds = {c.topic: c.msgtype for c in reader.connections}
        kept = {c.topic for c in reader.connections for q in c.ext.offered_qos_profiles if q.durability.value == 1}
        for c, time, data in reader.messages():
            out.setdefault(c.topic, []).append((time, reader.deserialize(data, c.msgtype)))
    assert kept == kinds.keys() - {"/tf", "/pose"}
    return out, kinds


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Run:
    log = gs.simulate("court", preset="light", seed=1, progress=False).slice(0.0, 12.0)
    return gs.run(log, frontend="scan-window", out=tmp_path_factory.mktemp("bag") / "run", progress=False)


@pytest.fixture(scope="module")
def field() -> Run:
    log = gs.simulate("landmark-field", preset="quick", seed=1)
    return gs.run(log, frontend="ekf", config={"calibrate": {"use": "none"}}, progress=False)


def pose_of(p: Any) -> np.ndarray:
    o = getattr(p, "orientation", None) or p.rotation
    x = getattr(p, "position", None) or p.translation
    return np.array([x.x, x.y, x.z, o.x, o.y, o.z, o.w])


def check_path(run: Run, found: Messages) -> None:
    path = run.trajectory
    stamps = np.round(path.times * 1e9).astype(np.int64)
    poses = path.poses
    if path.dim == 2:
        half = poses[:, 2] / 2
        zero = np.zeros(len(half))
        poses = np.column_stack([poses[:, 0], poses[:, 1], zero, zero, zero, np.sin(half), np.cos(half)])
    for k, (time, m) in enumerate(found["/tf"]):
        (t,) = m.transforms
        assert (t.header.frame_id, t.child_frame_id) == ("map", "base")
        assert time == stamps[k] == t.header.stamp.sec * 10**9 + t.header.stamp.nanosec
        np.testing.assert_allclose(pose_of(t.transform), poses[k], atol=1e-12)
    assert len(found["/tf"]) == len(found["/pose"]) == len(path)
    ((first, whole),) = found["/path"]
    assert first == stamps[0]
    np.testing.assert_allclose([pose_of(p.pose) for p in whole.poses], poses, atol=1e-12)
    wanted = ros_covariances(path.poses, path.covariances)
    for k, (_, m) in enumerate(found["/pose"]):
        np.testing.assert_allclose(pose_of(m.pose.pose), poses[k], atol=1e-12)
        np.testing.assert_allclose(m.pose.covariance.reshape(6, 6), wanted[k], atol=1e-15)


@pytest.mark.parametrize("form", ["mcap", "ros2"])
def test_a_run_with_a_dense_map_is_read_back(hall: Run, tmp_path: Path, form: str) -> None:
    out = export(hall, format=form, out=tmp_path / "bag")
    found, kinds = from_mcap(out) if form == "mcap" else from_ros2(out)
    maps = sorted(t for t in kinds if t.startswith("/map"))
    assert {t: k for t, k in kinds.items() if t not in maps} == {t: k for t, k in TYPES.items() if t != "/map"}
    assert {kinds[t] for t in maps} == {TYPES["/map"]}
    check_path(hall, found)
    ((_, cloud),) = found["/points"]
    points = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(-1, 3)
    assert (cloud.width, cloud.height, cloud.point_step) == (len(points), 1, 12)
    np.testing.assert_array_equal(points, map_points(hall).astype(np.float32))
    export(hall, format="nav2", out=tmp_path / "nav")
    plans = [read_map_server(f) for f in sorted((tmp_path / "nav").glob("*.yaml"))]
    assert len(plans) == len(maps)
    for topic, (cells, info) in zip(maps, plans):
        ((_, m),) = found[topic]
        assert m.header.frame_id == "map"
        np.testing.assert_array_equal(m.data.reshape(m.info.height, m.info.width), cells)
        np.testing.assert_allclose(pose_of(m.info.origin)[:2], info["origin"][:2])
        assert m.info.resolution == pytest.approx(info["resolution"])


@pytest.mark.parametrize("form", ["mcap", "ros2"])
def test_a_planar_run_is_read_back_with_ellipses(field: Run, tmp_path: Path, form: str) -> None:
    out = export(field, format=form, out=tmp_path / "bag", confidence=0.9)
    found, kinds = from_mcap(out) if form == "mcap" else from_ros2(out)
    assert kinds == {t: k for t, k in TYPES.items() if t not in ("/map", "/points")}
    check_path(field, found)
    ((_, array),) = found["/markers"]
    shown = [m for m in array.markers if m.ns == "landmark ellipses"]
    assert len(shown) == len(field.map.landmarks)
    for m, p, P in zip(shown, field.map.landmarks, field.map.landmark_covariances):
        T = pose_of(m.pose)
        np.testing.assert_allclose(T[:2], p, atol=1e-12)
        R, size = quat_to_matrix(T[3:])[:2, :2], np.array([m.scale.x, m.scale.y]) / 2
        np.testing.assert_allclose(R @ np.diag(size**2) @ R.T, chi2.ppf(0.9, 2) * P, atol=1e-12)
    (dots,) = [m for m in array.markers if m.ns == "landmarks"]
    np.testing.assert_allclose([[p.x, p.y] for p in dots.points], field.map.landmarks, atol=1e-12)
    assert len({(m.ns, m.id) for m in array.markers}) == len(array.markers)


def test_loops_are_lines_between_the_bases_of_their_submaps(field: Run) -> None:
    event = {"event": "loop", "loop": 0, "verdict": "accepted", "why": "", "i": 1, "j": 4, "submap_i": 1, "submap_j": 4}
    field.events.extend([event, {**event, "loop": 1, "verdict": "rejected"}])
    try:
        (ends,) = loop_ends(field)
    finally:
        del field.events[-2:]
    np.testing.assert_array_equal(ends[:, :2], field.map.base_poses[[1, 4], :2])


def test_covariances_of_ros_are_along_the_axes_of_the_map(rng: np.random.Generator) -> None:
    """By Monte Carlo of the right tangents, in the plane and in space."""
    n = 100_000
    A = rng.standard_normal((6, 6))
    P = 1e-4 * (A @ A.T + np.eye(6))
    pose = np.concatenate([[1.0, 2.0, 3.0], se3.quat_normalize(rng.standard_normal(4))])
    drawn = se3.se3_compose(pose, se3.se3_exp(rng.multivariate_normal(np.zeros(6), P, n)))
    R = quat_to_matrix(drawn[:, 3:]) @ quat_to_matrix(pose[3:]).T  # a small rotation about the axes of the map
    turned = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    seen = np.cov(np.column_stack([drawn[:, :3], turned]).T)
    claimed = ros_covariances(pose[None], P[None])[0]
    s = np.sqrt(np.diag(claimed))
    np.testing.assert_allclose(seen / np.outer(s, s), claimed / np.outer(s, s), atol=0.03)
    flat, Q = np.array([1.0, -2.0, 0.7]), P[:3, :3]
    e = se2_compose(flat, se2_exp(rng.multivariate_normal(np.zeros(3), Q, n)))
    claimed = ros_covariances(flat[None], Q[None])[0]
    seen = np.cov(np.column_stack([e[:, :2], se2_between(flat, e)[:, 2]]).T)
    s = np.sqrt(np.diag(seen))
    np.testing.assert_allclose(claimed[np.ix_([0, 1, 5], [0, 1, 5])] / np.outer(s, s), seen / np.outer(s, s), atol=0.03)
    assert not claimed[2:5].any()


def test_an_ellipsoid_is_its_covariance(rng: np.random.Generator) -> None:
    A = rng.standard_normal((3, 3))
    pose, size = ellipsoid(np.zeros(3), A @ A.T, 0.5)
    R = quat_to_matrix(pose[3:])
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(R @ np.diag((size / 2) ** 2) @ R.T, chi2.ppf(0.5, 3) * A @ A.T, atol=1e-9)


def test_a_bag_is_swapped_whole_and_nothing_else_is_replaced(
    field: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import graphslam.io.bag_writer as writing

    bag = export(field, format="ros2", out=tmp_path / "bag")
    before = {p.name: p.read_bytes() for p in bag.iterdir()}
    export(field, format="ros2", out=bag)
    assert {p.name for p in bag.iterdir()} == before.keys()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(OutputError, match=r"thesis\.tex; wanted a new or empty folder for the bag"):
        export(field, format="ros2", out=tmp_path / "mine")

    def broken(*_: Any) -> None:
        raise OSError(28, "no space")

    monkeypatch.setattr(writing, "_serialised", broken)
    for form, name in (("ros2", "bag"), ("mcap", "a.mcap")):
        with pytest.raises(OSError, match="no space"):
            export(field, format=form, out=tmp_path / name)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "mine"]


def test_one_in_the_folder_of_its_run_and_the_name_by_default(hall: Run) -> None:
    assert export(hall, format="mcap").name == "run.mcap"
    assert from_mcap(hall.folder / "run.mcap")[1].keys() > {"/tf", "/points"}
    bag = export(hall, format="ros2", out=hall.folder / "bag")
    assert from_ros2(bag)[1].keys() > {"/tf", "/points"}
    assert gs.open_run(hall.folder).metric("submaps") == hall.metric("submaps")
