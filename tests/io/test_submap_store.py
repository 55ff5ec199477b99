"""The submap store: what goes in comes out, the bytes are the same, and no damage passes for data."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp

from graphslam.core.dense import CloudMap
from graphslam.core.errors import CovarianceError, DataError, FormatError, GeometryError, MissingDataError
from graphslam.core.map_truth import MapTruth
from graphslam.core.submap import LandmarkMap, Match, Submap
from graphslam.core.trajectory import Trajectory
from graphslam.io.submap_store import SubmapStore, read_submaps, read_truth, write_submaps, write_truth
from tests.reference.submap_chain import submap_chain

ROOT = Path(__file__).resolve().parents[2]


def rich(rng: np.random.Generator, s: Submap) -> Submap:
    """The submap with every optional part."""
    n = 5
    return replace(
        s,
        interval=(s.key + 0.1, s.key + 0.9 + 1e-9),
        landmarks=replace(s.landmarks, detections=np.array([[3, 0], [4, 1], [9, 0]])),
        trajectory=Trajectory(np.arange(n) + s.key, rng.normal(size=(n, 3)), np.tile(np.diag([1.0, 2, 3]), (n, 1, 1))),
        cloud=CloudMap(
            points=rng.normal(size=(7, 2)), origins=np.eye(2), scan=np.array([0, 1, 1, 0, 1, 0, 0]), cell=0.3
        ),
        matches=(
            Match(target=0, T_target_here=np.array([1.0, 2, 3]), covariance=np.eye(3), fitness=0.5, support=0.25),
            Match(target=1, T_target_here=np.zeros(3), covariance=2 * np.eye(3), fitness=0.1, support=0.5),
        ),
        uses=frozenset({"laser", "controls"}),
        report={"reason": "30 Merkmale · σ", "ess": np.float64(3.5), "counts": np.arange(3)},
    )


def assert_same(a: Submap, b: Submap) -> None:
    for name in ("key", "interval", "uses"):
        assert getattr(a, name) == getattr(b, name)
    for name in ("exit_pose", "exit_covariance"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.landmarks is None) == (b.landmarks is None)
    if a.landmarks is not None and b.landmarks is not None:
        np.testing.assert_array_equal(a.landmarks.ids, b.landmarks.ids)
        assert a.landmarks.chart == b.landmarks.chart
        np.testing.assert_array_equal(a.landmarks.positions, b.landmarks.positions)
        if a.landmarks.information is not None:
            assert (a.landmarks.information != b.landmarks.information).nnz == 0
            assert b.landmarks.covariance is None
        else:
            np.testing.assert_array_equal(a.landmarks.covariance, b.landmarks.covariance)
        if a.landmarks.detections is not None:
            np.testing.assert_array_equal(a.landmarks.detections, b.landmarks.detections)
    if a.trajectory is not None:
        for name in ("times", "poses", "covariances"):
            np.testing.assert_array_equal(getattr(a.trajectory, name), getattr(b.trajectory, name))
    assert [m.target for m in a.matches] == [m.target for m in b.matches]
    for p, q in zip(a.matches, b.matches):
        np.testing.assert_array_equal(p.T_target_here, q.T_target_here)
        np.testing.assert_array_equal(p.covariance, q.covariance)
        assert (p.fitness, p.support) == (q.fitness, q.support)
    if a.cloud is not None:
        for name in ("points", "origins", "scan", "cell"):
            np.testing.assert_array_equal(getattr(a.cloud, name), getattr(b.cloud, name))


@pytest.fixture
def submaps(rng: np.random.Generator) -> list[Submap]:
    plain, _ = submap_chain(rng, submaps=4)
    I = np.linalg.inv(plain[1].landmarks.covariance)
    sparse = replace(plain[1].landmarks, covariance=None, information=sp.csc_matrix(0.5 * (I + I.T)), chart="group")
    blind = replace(plain[2], landmarks=None)
    lost = plain[3].with_ids(np.full(len(plain[3].landmarks), -1))
    return [rich(rng, plain[0]), Submap.from_landmarks(1, sparse), blind, lost]


def test_round_trip_keeps_every_bit(tmp_path: Path, submaps: list[Submap]) -> None:
    write_submaps(tmp_path, submaps)
    for where in (tmp_path, tmp_path / "submaps"):
        back = read_submaps(where)
        assert len(back) == len(submaps)
        for a, b in zip(submaps, back):
            assert_same(a, b)
    assert back[0].report == {"reason": "30 Merkmale · σ", "ess": 3.5, "counts": [0, 1, 2]}
    assert sorted(p.name for p in (tmp_path / "submaps").iterdir()) == [
        *(f"{k:06d}.npz" for k in range(4)),
        "index.json",
    ]
    index = json.loads((tmp_path / "submaps" / "index.json").read_text())
    assert index["format"] == "graphslam.submaps/1"
    assert (index["dim"], index["count"]) == (2, 4)
    assert index["submaps"][2] == {"key": 2, "file": "000002.npz", "interval": [2.0, 3.0], "landmarks": 0}


def test_three_dimensions(tmp_path: Path) -> None:
    P = np.diag(np.arange(1.0, 10.0))
    pose = np.array([1.0, 2, 3, 0, 0, 0.6, 0.8])
    m = LandmarkMap(ids=np.array([5]), exit_pose=pose, positions=np.array([[1.0, 2, 3]]), covariance=P)
    flying = [
        Submap.from_landmarks(0, m),
        Submap(key=3, interval=(1.0, 2.0), exit_pose=pose, exit_covariance=np.eye(6)),
    ]
    write_submaps(tmp_path, flying)
    for a, b in zip(flying, read_submaps(tmp_path)):
        assert_same(a, b)


def test_the_same_submaps_give_the_same_bytes(tmp_path: Path, submaps: list[Submap]) -> None:
    write_submaps(tmp_path / "a", submaps)
    time.sleep(1.1)  # a stamp of the clock would show
    write_submaps(tmp_path / "b", submaps)
    for file in (tmp_path / "a" / "submaps").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / "submaps" / file.name).read_bytes()


def test_a_store_as_the_format_is_written_down_can_be_read(tmp_path: Path, submaps: list[Submap]) -> None:
    """Only the arrays the format asks for, written by somebody else."""
    s = submaps[0]
    folder = tmp_path / "submaps"
    folder.mkdir()
    np.savez(
        folder / "000000.npz",
        format="graphslam.submap/2",
        chart="cartesian",
        key=0,
        interval=[0, 1],
        dim=2,
        exit_pose=s.exit_pose,
        landmark_ids=s.landmarks.ids.astype(np.int32),
        landmarks=s.landmarks.positions,
        covariance=s.landmarks.covariance,
        used=np.array(["laser"]),
    )
    entry = {"key": 0, "file": "000000.npz", "interval": [0, 1], "landmarks": len(s.landmarks)}
    (folder / "index.json").write_text(
        json.dumps({"format": "graphslam.submaps/1", "dim": 2, "count": 1, "submaps": [entry]})
    )
    (back,) = read_submaps(tmp_path)
    np.testing.assert_allclose(back.exit_covariance, s.exit_covariance, atol=1e-15)
    np.testing.assert_array_equal(back.landmarks.ids, s.landmarks.ids)
    assert back.uses == {"laser"}


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_a_truncated_file_is_named(tmp_path: Path, submaps: list[Submap], share: float) -> None:
    write_submaps(tmp_path, submaps)
    file = tmp_path / "submaps" / "000001.npz"
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(FormatError, match=r"000001\.npz"):
        read_submaps(tmp_path)
    assert len(SubmapStore(tmp_path).complete_prefix()) == 1


def test_flipped_bytes_never_pass_unseen(tmp_path: Path, submaps: list[Submap], rng: np.random.Generator) -> None:
    write_submaps(tmp_path, submaps[:1])
    file = tmp_path / "submaps" / "000000.npz"
    data = file.read_bytes()
    caught = 0
    for at in rng.choice(len(data), 60, replace=False):
        broken = bytearray(data)
        broken[at] ^= 0xFF
        file.write_bytes(bytes(broken))
        refusal = None
        try:
            (back,) = read_submaps(tmp_path)
        except DataError as error:
            refusal = str(error)
        if refusal is None:
            assert_same(submaps[0], back)  # a byte of zip book-keeping that nothing depends on
        else:
            assert "000000.npz" in refusal
            caught += 1
    assert caught > 30


def corrupt(tmp_path: Path, submaps: list[Submap], **changes: object) -> Path:
    write_submaps(tmp_path, submaps[:1])
    file = tmp_path / "submaps" / "000000.npz"
    with np.load(file) as archive:
        arrays = {k: archive[k] for k in archive.files}
    arrays |= changes
    np.savez(file, **{k: v for k, v in arrays.items() if v is not None})
    return tmp_path


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"format": "graphslam.submap/3"}, FormatError, "unknown format"),
        ({"chart": "polar"}, FormatError, "unknown chart 'polar'"),
        ({"format": None}, FormatError, "unknown format"),
        ({"exit_pose": None}, FormatError, "'exit_pose' is missing"),
        ({"exit_pose": np.zeros(7)}, FormatError, "wrong shape"),
        ({"dim": 4}, FormatError, "do not agree"),
        ({"dim": "two"}, FormatError, ".dim. has the wrong shape or type"),
        ({"interval": np.array([3.0, 3.0])}, GeometryError, "empty"),
        ({"interval": np.array([3.0])}, FormatError, ".interval. has the wrong shape"),
        ({"landmark_ids": np.array([0.5, 1.5])}, FormatError, ".landmark_ids. has the wrong shape or type"),
        ({"landmark_ids": np.array([1])}, FormatError, ".landmarks. has the wrong shape"),
        ({"covariance": np.zeros((3, 3))}, CovarianceError, "shape"),
        ({"report": "{"}, FormatError, "report: not JSON"),
        ({"trajectory_times": np.array([2.0, 1.0, 3.0, 4.0, 5.0])}, DataError, "trajectory"),
        ({"exit_pose": np.array([np.nan, 0.0, 0.0])}, FormatError, "not finite"),
        ({"landmarks": np.array([{}], dtype=object)}, FormatError, "truncated or corrupt"),
    ],
)
def test_impossible_files_are_refused_by_name(
    tmp_path: Path, submaps: list[Submap], changes: dict, error: type, message: str
) -> None:
    with pytest.raises(error, match=message) as caught:
        read_submaps(corrupt(tmp_path, submaps, **changes))
    assert "000000.npz" in str(caught.value)


def test_zero_covariance_is_refused_by_name(tmp_path: Path, submaps: list[Submap]) -> None:
    n = len(submaps[0].landmarks.covariance)
    with pytest.raises(CovarianceError, match=r"000000\.npz.*positive definite"):
        read_submaps(corrupt(tmp_path, submaps, covariance=np.zeros((n, n))))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"format": "graphslam.submaps/9", "dim": 2, "count": 0, "submaps": []}', "unknown format"),
        ('{"dim": 2}', "unknown format"),
        ("[]", "not a JSON object"),
        ('{"format": "graphslam.submaps/1", "dim": 2, "count": 1, "submaps": []}', "count or dim"),
        ('{"format": "graphslam.submaps/1", "dim": 2, "count": 0', "truncated"),
        ('{"format": "graphslam.submaps/1", "dim": 2, "count": 1, "submaps": [{"key": 0}]}', "missing"),
        (
            '{"format": "graphslam.submaps/1", "dim": 2, "count": 1, "submaps": '
            '[{"key": 0, "file": "../000000.npz", "interval": [0, 1], "landmarks": 0}]}',
            "leads out of its folder",
        ),
    ],
)
def test_a_bad_index_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "index.json").write_text(text)
    with pytest.raises(FormatError, match=message) as caught:
        read_submaps(tmp_path)
    assert "index.json" in str(caught.value)


def test_index_and_files_must_agree(tmp_path: Path, submaps: list[Submap]) -> None:
    write_submaps(tmp_path, submaps)
    folder = tmp_path / "submaps"
    (folder / "000001.npz").write_bytes((folder / "000003.npz").read_bytes())
    with pytest.raises(FormatError, match="do not agree"):
        read_submaps(tmp_path)
    assert len(SubmapStore(folder).complete_prefix()) == 1


def test_no_store_and_an_empty_store(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="no submap store"):
        read_submaps(tmp_path / "nowhere")
    assert SubmapStore(tmp_path / "nowhere").complete_prefix() == []
    (tmp_path / "index.json").write_text('{"format": "graphslam.submaps/1", "dim": 2, "count": 0, "submaps": []}')
    assert read_submaps(tmp_path) == []


def test_append_refuses_what_breaks_the_chain(tmp_path: Path, submaps: list[Submap]) -> None:
    store = SubmapStore(tmp_path / "submaps")
    store.append(submaps[1])
    with pytest.raises(DataError, match="does not rise"):
        store.append(submaps[0])
    flying = Submap(key=9, interval=(0.0, 1.0), exit_pose=np.array([0, 0, 0, 0, 0, 0, 1.0]), exit_covariance=np.eye(6))
    with pytest.raises(DataError, match="3-D"):
        store.append(flying)
    with pytest.raises(FormatError, match="JSON"):
        store.append(replace(submaps[2], report={"why": object()}))
    assert len(SubmapStore(tmp_path)) == 1


def test_resume_keeps_the_complete_prefix_and_sweeps_the_rest(tmp_path: Path, submaps: list[Submap]) -> None:
    write_submaps(tmp_path / "whole", submaps)
    write_submaps(tmp_path / "cut", submaps[:2])
    folder = tmp_path / "cut" / "submaps"
    (folder / ".000002.npz.77-0123abcd.part").write_bytes(b"half")
    (folder / "000002.npz").write_bytes(b"written, but the index does not name it yet")
    store = SubmapStore(folder)
    prefix = store.complete_prefix()
    assert len(prefix) == 2
    store.truncate(len(prefix))
    for s in submaps[2:]:
        store.append(s)
    names = {p.name for p in folder.iterdir()}
    assert names == {p.name for p in (tmp_path / "whole" / "submaps").iterdir()}
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / "whole" / "submaps" / name).read_bytes()
    store.truncate(1)
    assert {p.name for p in folder.iterdir()} == {"000000.npz", "index.json"}


WRITER = """
import sys, numpy as np
from graphslam.io.submap_store import SubmapStore
from tests.reference.submap_chain import submap_chain
submaps, _ = submap_chain(np.random.default_rng(5), submaps=40, landmarks=60, reach=25.0)
store = SubmapStore(sys.argv[1])
done = store.complete_prefix()
store.truncate(len(done))
print("ready", flush=True)
for s in submaps[len(done):]:
    store.append(s)
    print("stored", flush=True)
"""


def test_killed_writers_resume_to_the_same_bytes(tmp_path: Path, rng: np.random.Generator) -> None:
    def run(folder: Path) -> subprocess.Popen[str]:
        writer = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(folder)], stdout=subprocess.PIPE, text=True, cwd=ROOT
        )
        assert writer.stdout is not None
        assert writer.stdout.readline() == "ready\n"
        return writer

    whole, killed = tmp_path / "whole" / "submaps", tmp_path / "killed" / "submaps"
    assert run(whole).communicate()[0].count("stored") == 40
    for _ in range(3):
        writer = run(killed)
        assert writer.stdout is not None
        for _ in range(rng.integers(1, 13)):  # the kill falls somewhere in the writing of the next submap
            assert writer.stdout.readline() == "stored\n"
        time.sleep(rng.uniform(0.0, 0.005))
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        assert 0 < len(SubmapStore(killed).complete_prefix()) <= 40
    run(killed).communicate()
    assert {p.name for p in killed.iterdir()} == {p.name for p in whole.iterdir()}
    for file in whole.iterdir():
        assert file.read_bytes() == (killed / file.name).read_bytes()


class Payload:
    """A dense payload that knows how to save itself."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def save(self, path: Path) -> None:
        np.savez(path, values=self.values)


def test_the_grid_lies_beside_its_submap(tmp_path: Path, submaps: list[Submap]) -> None:
    write_submaps(tmp_path, [replace(submaps[0], grid=Payload(np.arange(6.0)))])
    assert (tmp_path / "submaps" / "000000.grid.npz").is_file()
    assert read_submaps(tmp_path)[0].grid is None
    (back,) = read_submaps(tmp_path, load_grid=lambda p: Payload(np.load(p)["values"]))
    np.testing.assert_array_equal(back.grid.values, np.arange(6.0))


def test_truth_beside_the_store(tmp_path: Path, rng: np.random.Generator) -> None:
    submaps, truth = submap_chain(rng, submaps=3)
    write_submaps(tmp_path / "run", submaps, truth=truth)
    for where in ("run", "run/submaps", "run/truth.npz"):
        back = read_truth(tmp_path / where)
        assert back is not None
        for name in ("keys", "exit_poses", "landmark_ids", "landmarks"):
            np.testing.assert_array_equal(getattr(back, name), getattr(truth, name))
    write_submaps(tmp_path / "run" / "other", submaps)
    assert read_truth(tmp_path / "run" / "other") is None  # somebody else's truth
    np.savez(tmp_path / "truth.npz", keys=[0])
    with pytest.raises(FormatError, match=r"truth\.npz.*missing"):
        read_truth(tmp_path / "truth.npz")
    np.savez(tmp_path / "truth.npz", keys=[0, 0], exit_poses=np.zeros((2, 3)), landmark_ids=[], landmarks=[])
    with pytest.raises(GeometryError, match=r"truth\.npz.*twice"):
        read_truth(tmp_path / "truth.npz")


def test_truth_is_checked() -> None:
    none = np.zeros(0, dtype=np.int64)
    for poses, points in ((np.zeros((2, 3)), np.zeros((0, 2))), (np.full((1, 3), np.nan), np.zeros((0, 2)))):
        with pytest.raises(GeometryError):
            MapTruth(keys=np.zeros(1, dtype=np.int64), exit_poses=poses, landmark_ids=none, landmarks=points)
    with pytest.raises(GeometryError, match="landmarks"):
        MapTruth(keys=none, exit_poses=np.zeros((0, 3)), landmark_ids=np.array([1]), landmarks=np.zeros((2, 2)))


def test_truth_needs_its_folder(tmp_path: Path, rng: np.random.Generator) -> None:
    _, truth = submap_chain(rng, submaps=2)
    write_truth(tmp_path, truth)
    assert (tmp_path / "truth.npz").is_file()
