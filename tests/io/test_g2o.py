"""Pose-network files: read, written, and refused with file and line."""

from __future__ import annotations

import gzip
import lzma
from pathlib import Path

import gtsam
import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.core.errors import ConfigError, CovarianceError, FormatError, MissingDataError
from graphslam.core.network import PoseNetwork
from graphslam.core.se3 import quat_to_matrix
from graphslam.io.g2o import read_g2o, write_g2o
from graphslam.io.isam_graph import parse_isam_graph
from graphslam.io.network_file import read_network
from graphslam.solve.network.multistart import canonical_start
from graphslam.solve.network.solve import solve_network
from tests.reference.gtsam_network import to_graph
from tests.reference.gtsam_twin import to_gtsam

SE2 = """VERTEX_SE2 0 0 0 0
VERTEX_SE2 7 1 0.1 0.2

# a comment
FIX 0
EDGE_SE2 0 7 1 0.1 0.2 1 0.1 0.2 4 0.3 9
"""
INFO3 = " ".join(str(v) for v in np.eye(6)[np.triu_indices(6)])
SE3 = f"""VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 2e0
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {INFO3}
""".replace("2e0", "1.00001")


def put(folder: Path, text: str, name: str = "f.g2o") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_reads_se2_with_blank_lines_comments_and_fix(tmp_path: Path) -> None:
    net = read_g2o(put(tmp_path, SE2))
    assert net.ids.tolist() == [0, 7]
    assert net.fixed.tolist() == [True, False]
    assert np.array_equal(net.information[0], [[1, 0.1, 0.2], [0.1, 4, 0.3], [0.2, 0.3, 9]])


def test_3d_information_is_turned_to_rotation_first(tmp_path: Path) -> None:
    omega = np.diag([1.0, 2, 3, 4, 5, 6])
    omega[0, 5] = omega[5, 0] = 0.5  # x with the third rotation component
    upper = " ".join(str(v) for v in omega[np.triu_indices(6)])
    net = read_g2o(put(tmp_path, f"EDGE_SE3:QUAT 3 4 1 0 0 0 0 0 1 {upper}\n"))
    assert np.diag(net.information[0]).tolist() == [4, 5, 6, 1, 2, 3]
    assert net.information[0][3, 2] == 0.5
    assert not net.has_initial.any()


@pytest.mark.parametrize("suffix", ["", ".xz", ".gz", ".bz2"])
def test_write_and_read_back_is_exact(tmp_path: Path, rng: np.random.Generator, suffix: str) -> None:
    n, m = 6, 9
    A = rng.standard_normal((m, 6, 6))
    edges = np.array([(i, j) for i in range(n) for j in range(i + 1, n)])[:m]
    q = rng.standard_normal((n + m, 4))
    pose = np.concatenate([rng.standard_normal((n + m, 3)), q / np.linalg.norm(q, axis=1)[:, None]], axis=1)
    pose[:, 3:] *= np.sign(pose[:, 6:])
    net = PoseNetwork(
        dim=3,
        ids=np.array([2, 3, 5, 7, 11, 13]),
        poses=pose[:n],
        has_initial=np.ones(n, bool),
        edges=edges,
        measurements=pose[n:],
        information=A @ np.swapaxes(A, 1, 2),
    )
    path = tmp_path / f"out.g2o{suffix}"
    write_g2o(path, net)
    back = read_network(path)
    assert back.ids.tolist() == net.ids.tolist()
    assert np.array_equal(back.edges, net.edges)
    assert np.allclose(back.poses, net.poses, rtol=0, atol=1e-15)
    assert np.allclose(back.measurements, net.measurements, rtol=0, atol=1e-15)
    assert np.array_equal(back.information, net.information)
    assert (path.read_bytes()[:5] != b"VERTE") == bool(suffix)
    assert not list(tmp_path.glob("*.tmp"))


def test_what_we_write_gtsam_reads_the_same(tmp_path: Path, data_dir: Path) -> None:
    net = read_network(data_dir / "posegraphs/smallGrid3D.g2o.xz")
    write_g2o(tmp_path / "g.g2o", net)
    graph, values = gtsam.readG2o(str(tmp_path / "g.g2o"), True)
    ours = to_graph(net)
    mine = to_gtsam(canonical_start(net), held=True)
    # ours has one gauge prior more, with residual zero at the file's values
    assert graph.size() == ours.size() - 1
    assert graph.error(values) == pytest.approx(ours.error(mine), rel=1e-9)


def test_landmarks_round_trip(tmp_path: Path) -> None:
    text = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
    seen = "VERTEX_XY 9 2 2\nEDGE_SE2_XY 0 9 2 2 4 1 5\nEDGE_SE2_XY 1 9 1 2 4 1 5\n"
    net = read_g2o(put(tmp_path, text + seen))
    assert net.observation_kind == "cartesian"
    assert net.has_landmark.tolist() == [True]
    write_g2o(tmp_path / "b.g2o", net)
    assert np.array_equal(
        read_g2o(tmp_path / "b.g2o").observation_information, np.tile([[4.0, 1.0], [1.0, 5.0]], (2, 1, 1))
    )
    polar = read_g2o(put(tmp_path, text + "BR 0 9 0.7 2.8 0.1 0.5\n"))
    assert polar.observation_kind == "bearing-range"
    write_g2o(tmp_path / "c.g2o", polar)
    assert np.allclose(read_g2o(tmp_path / "c.g2o").observation_information[0], np.diag([100.0, 4.0]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SE2 + "EDGE_SE2 0 7 1 0.1 0.2 1 0.1\n", r"f.g2o:7: EDGE_SE2 record is truncated"),
        (SE2 + "EDGE_SE2 0 7 1 0.1 0.2 1 0.1 0.2 4 0.3 9 9\n", r":7: .*too long; got 12 numbers; wanted 11"),
        (SE2 + "EDGE_SE2 0 7 1 x 0.2 1 0.1 0.2 4 0.3 9\n", r":7: EDGE_SE2 record holds no number"),
        (SE2 + "EDGE_SE2 0 7 1 nan 0.2 1 0.1 0.2 4 0.3 9\n", r":7: EDGE_SE2 record holds nan"),
        (SE2 + "EDGE_SE2 0 7 1 0 0.2 inf 0.1 0.2 4 0.3 9\n", r":7: EDGE_SE2 record holds inf"),
        (SE2 + "EDGE_SE2 7 7 1 0 0.2 1 0 0 1 0 1\n", r":7: an edge joins a vertex to itself"),
        (SE2 + "VERTEX_SE2 7 0 0 0\n", r":7: vertex given twice"),
        (SE2 + "VERTEX_SE2 -3 0 0 0\n", r":7: impossible vertex id"),
        (SE2 + "FIX 8\n", r":7: FIX names a vertex without a pose"),
        (SE2 + "EDGE_SE9 0 1\n", r":7: unknown record 'EDGE_SE9'"),
        (SE2 + SE3, r"EDGE_SE2|VERTEX_SE2 and VERTEX_SE3:QUAT in one file"),
        (SE3.replace("0 0 0 1.00001", "0 0 0 0"), r":2: not a unit quaternion"),
        ("VERTEX_SE2 0 0 0 0\n", r"no edges in the file"),
    ],
)
def test_broken_files_are_refused_with_file_and_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read_g2o(put(tmp_path, text))


def test_broken_compression_empty_and_missing_files(tmp_path: Path) -> None:
    whole = lzma.compress(SE2.encode() * 50)
    (tmp_path / "cut.g2o.xz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "cut.g2o.gz").write_bytes(gzip.compress(SE2.encode())[:-9])
    (tmp_path / "binary.g2o").write_bytes(bytes(range(256)))
    (tmp_path / "empty.g2o").write_text("\n\n")
    for name, message in (
        ("cut.g2o.xz", "truncated or corrupt"),
        ("cut.g2o.gz", "truncated or corrupt"),
        ("binary.g2o", "not a text file"),
        ("empty.g2o", "an empty file"),
    ):
        with pytest.raises(FormatError, match=message):
            read_network(tmp_path / name)
    with pytest.raises(FormatError, match="not a pose network"):
        read_network(put(tmp_path, "hello world\n"))
    with pytest.raises(MissingDataError, match="no such file"):
        read_network(tmp_path / "nowhere.g2o")
    with pytest.raises(MissingDataError, match="cannot be read"):
        read_network(tmp_path)


def test_indefinite_edges_are_named_refused_and_repaired_on_request(tmp_path: Path) -> None:
    text = SE2 + "VERTEX_SE2 9 0 0 0\nEDGE_SE2 7 9 1 0 0 1 2 0 1 0 1\nEDGE_SE2 9 0 1 0 0 1 0 0 1 0 1\n"
    path = put(tmp_path, text)
    with pytest.raises(CovarianceError, match=r"1 of 3 .*indefinite: 7 -> 9"):
        read_g2o(path)
    net = read_g2o(path, repair=True)
    assert net.repaired == 1
    assert np.linalg.eigvalsh(net.information).min() > 0.0
    assert np.allclose(net.information[1][:2, :2], 1.5, atol=1e-6)  # the positive part of [[1, 2], [2, 1]]


E2 = "EDGE2 0 1 1 0 0 {}\nEDGE2 1 2 1 0 0 {}\n"


def test_noise_columns_of_toro_and_isam_lines(tmp_path: Path) -> None:
    toro = put(tmp_path, E2.format(*["2 0 3 4 0 0"] * 2), "a.graph")
    assert np.diag(read_network(toro).information[0]).tolist() == [2, 3, 4]
    isam = put(tmp_path, E2.format(*["2 0 0 4 0 0.2"] * 2), "a.txt")
    assert np.allclose(np.diag(read_network(isam).information[0]), [0.5, 0.25, 5])
    root = read_network(isam, noise="sqrt-information")
    assert np.allclose(np.diag(root.information[0]), [4, 16, 0.04])
    assert "square-root" in root.noise
    full = put(tmp_path, E2.format(*["2 0.1 0.2 4 0.3 5"] * 2), "b.txt")
    with pytest.raises(FormatError, match="is not clear from the numbers"):
        read_network(full)
    R = np.array([[2, 0.1, 0.2], [0, 4, 0.3], [0, 0, 5]])
    assert np.allclose(read_network(full, noise="sqrt-information").information[0], R.T @ R)
    cov = R + np.triu(R, 1).T
    assert np.allclose(read_network(full, noise="covariance").information[0], np.linalg.inv(cov))
    assert np.allclose(read_network(full, noise="information").information[0], cov)
    with pytest.raises(ConfigError, match="unknown noise format"):
        read_network(full, noise="guess")  # type: ignore[arg-type]


def test_zero_covariance_is_refused(tmp_path: Path) -> None:
    path = put(tmp_path, E2.format("2 0 0 4 0 5", "0 0 0 4 0 5"), "z.txt")
    with pytest.raises(CovarianceError, match=r"not positive definite: 1 -> 2"):
        read_network(path, noise="covariance")


def test_victoria_park_graph_is_read_as_gtsam_reads_it(tmp_path: Path, data_dir: Path) -> None:
    path = data_dir / "victoria_park_graph/victoria_park.txt.gz"
    net = read_network(path)
    assert (len(net), len(net.edges), len(net.landmark_ids), len(net.observations)) == (6969, 6968, 151, 3640)
    (tmp_path / "vp.txt").write_bytes(gzip.decompress(path.read_bytes()))
    graph, _ = gtsam.load2D(str(tmp_path / "vp.txt"))
    start = canonical_start(net)
    poses, marks = start.poses, start.landmarks
    values = gtsam.Values()
    for vertex, pose in zip(net.ids, poses, strict=True):
        values.insert(int(vertex), gtsam.Pose2(*pose))
    for mark, point in zip(net.landmark_ids, marks, strict=True):
        values.insert(gtsam.symbol("l", int(mark)), point)
    assert graph.error(values) == pytest.approx(to_graph(net).error(to_gtsam(start, held=True)), rel=1e-9)


def test_anisotropic_landmark_noise_stays_cartesian() -> None:
    text = "ODOMETRY 0 1 1 0 0 1 0 0 1 0 1\nLANDMARK 1 2 3 4 0.5 0.1 0.25\n"
    net = parse_isam_graph("l.txt", text)
    assert net.observation_kind == "cartesian"
    assert np.allclose(net.observation_information[0], np.linalg.inv([[0.5, 0.1], [0.1, 0.25]]))
    root = parse_isam_graph("l.txt", text, noise="sqrt-information")
    R = np.array([[0.5, 0.1], [0.0, 0.25]])
    assert np.allclose(root.observation_information[0], R.T @ R)
    both = text + "ODOMETRY 1 2 1 0 0 1 0 0 1 0 1\n"
    with pytest.raises(FormatError, match="for a pose and for a landmark; got 2"):
        parse_isam_graph("m.txt", both)


def test_files_as_other_programs_write_them(tmp_path: Path) -> None:
    """A byte order mark, comments behind records, tags and scans between them, quaternions of three digits."""
    plain = read_g2o(put(tmp_path, SE2))
    path = tmp_path / "other.g2o"
    path.write_text(
        "\ufeff" + SE2.replace("0.3 9", "0.3 9  # odometry") + "VERTEX_TAG 7 a b\nROBOTLASER1 0 1.5 2\n", "utf-8"
    )
    other = read_network(path)
    assert np.array_equal(other.ids, plain.ids)
    assert np.array_equal(other.information, plain.information)
    rounded = read_g2o(put(tmp_path, SE3.replace("1.00001", "1.02")))
    np.testing.assert_allclose(np.linalg.norm(rounded.poses[:, 3:], axis=1), 1.0)


def test_keys_of_gtsam_are_ids(tmp_path: Path) -> None:
    keys = [gtsam.symbol("x", k) for k in range(2)]
    path = put(tmp_path, f"EDGE_SE2 {keys[0]} {keys[1]} 1 0 0 1 0 0 1 0 1\n")
    assert read_g2o(path).ids.tolist() == keys
    write_g2o(tmp_path / "b.g2o", read_g2o(path))
    assert read_g2o(tmp_path / "b.g2o").ids.tolist() == keys


def test_priors_are_edges_from_the_origin(tmp_path: Path) -> None:
    prior = "EDGE_PRIOR_SE2 7 2 0 0.5 100 0 0 100 0 100\n"
    net = read_g2o(put(tmp_path, SE2.replace("FIX 0\n", "") + prior))
    origin = int(np.flatnonzero(net.fixed)[0])
    assert net.poses[origin].tolist() == [0, 0, 0]
    k = int(np.flatnonzero(net.edges[:, 0] == origin)[0])
    assert net.ids[net.edges[k, 1]] == 7
    assert net.measurements[k].tolist() == [2, 0, 0.5]
    solved = solve_network(net).poses
    np.testing.assert_allclose(solved[list(net.ids).index(7)], [2, 0, 0.5], atol=1e-9)
    spatial = read_g2o(put(tmp_path, SE3 + f"EDGE_PRIOR_SE3:QUAT 1 0 3 0 0 0 0 0 1 {INFO3}\n"))
    assert spatial.poses[np.flatnonzero(spatial.fixed)[0]].tolist() == [0, 0, 0, 0, 0, 0, 1]


def test_diagonals_of_isam_are_square_roots_of_information(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As covariances they would say nothing of turns; landmarks beside them are meant the same way."""
    text = "EDGE2 0 1 1 0 0.1 10 0 0 10 0 50\nODOMETRY 1 2 1 0 0.1 10 0 0 10 0 50\nLANDMARK 0 3 2 1 4 0 8\n"
    net = read_network(put(tmp_path, text, "isam.txt"))
    assert np.diag(net.information[1]).tolist() == [100, 100, 2500]
    assert np.diag(net.observation_information[0]).tolist() == [16, 64]
    assert "square-root" in net.noise
    assert "read as sqrt-information, so that σ of a turn is 0.02 rad" in caplog.text
    doubtful = read_network(put(tmp_path, text.replace("50", "0.5"), "b.txt"))
    assert doubtful.information[0, 2, 2] == pytest.approx(2.0)
    assert "read as covariance, so that σ of a turn is 0.71 rad" in caplog.text
    asked = CliRunner().invoke(app, ["solve", str(put(tmp_path, text, "isam.txt")), "--noise", "covariance", "--json"])
    assert asked.exit_code == 0, asked.output


TORO_3D = """VERTEX3 0 0 0 0 0 0 0
VERTEX3 1 1 2 3 0.3 -0.4 1.2
VERTEX3 2 2 1 0 0 0 0
EDGE3 0 1 1 2 3 0.3 -0.4 1.2 {a}
EDGE3 1 2 0.4 -1 -2 0.2 0.1 -1.1 {b}
EDGE3 0 2 1.5 1.4 0.2 0.4 -0.2 0.3 {a}
EQUIV 0 1
"""


def test_three_dimensions_of_toro_and_isam(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The optimum is that of GTSAM with the same matrices, their rows put in its order (rotation first)."""
    r = np.random.default_rng(4)
    R = [np.triu(0.3 * r.normal(size=(6, 6)), 1) + np.diag(r.uniform(2, 9, 6)) for _ in range(2)]
    upper = np.triu_indices(6)
    swap = [3, 4, 5, 0, 1, 2]
    for noise, columns, information in (
        ("auto", [a.T @ a for a in R], [a.T @ a for a in R]),
        ("sqrt-information", R, [a.T @ a for a in R]),
        ("covariance", [np.linalg.inv(a.T @ a) for a in R], [a.T @ a for a in R]),
    ):
        a, b = (" ".join(format(v, ".17g") for v in m[upper]) for m in columns)
        net = read_network(put(tmp_path, TORO_3D.format(a=a, b=b), "t.graph"), noise=noise)  # type: ignore[arg-type]
        assert ("EDGE3 is read as information" in caplog.text) == (noise == "auto")
        caplog.clear()
        np.testing.assert_allclose(net.information[0], information[0][swap][:, swap], rtol=1e-9, atol=1e-9)
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3()))
        values = gtsam.Values()
        values.insert(0, gtsam.Pose3())
        for line in TORO_3D.splitlines():
            words = line.split()
            if words[0] == "EQUIV":
                continue
            n = {"VERTEX3": 2, "EDGE3": 3}[words[0]]
            x, y, z, roll, pitch, yaw = map(float, words[n : n + 6])
            pose = gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array([x, y, z]))
            if words[0] == "EDGE3":
                m = information[int(words[-1] == "{b}")][swap][:, swap]
                model = gtsam.noiseModel.Gaussian.Information(m)
                graph.add(gtsam.BetweenFactorPose3(int(words[1]), int(words[2]), pose, model))
            elif words[1] != "0":
                values.insert(int(words[1]), pose)
                at = list(net.ids).index(int(words[1]))
                np.testing.assert_allclose(net.poses[at, :3], [x, y, z])
                np.testing.assert_allclose(quat_to_matrix(net.poses[at, 3:]), pose.rotation().matrix(), atol=1e-12)
        best = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        solved = solve_network(net)
        assert solved.objective == pytest.approx(2.0 * graph.error(best), rel=1e-6)
        np.testing.assert_allclose(solved.poses[2, :3], best.atPose3(2).translation(), atol=1e-4)


def test_lines_without_noise_and_the_older_names(tmp_path: Path) -> None:
    net = read_network(put(tmp_path, "VERTEX 0 0 0 0\nVERTEX 1 1 0 0\nEDGE 0 1 1 0 0.1\n", "a.graph"))
    assert np.array_equal(net.information[0], np.eye(3))
    spatial = read_network(put(tmp_path, "EDGE3 0 1 1 0 0 0 0 0.5\nPOSE3D_TRUE 0 0 0 0 0 0 0\n", "b.txt"))
    assert np.array_equal(spatial.information[0], np.eye(6))
    np.testing.assert_allclose(spatial.measurements[0], [1, 0, 0, 0, 0, np.sin(0.25), np.cos(0.25)])
    with pytest.raises(FormatError, match=r"c\.txt:2: EDGE2 and EDGE3 in one file"):
        read_network(put(tmp_path, "EDGE2 0 1 1 0 0.1 1 0 0 1 0 1\nEDGE3 0 1 1 0 0 0 0 0.5\n", "c.txt"))


def test_priors_as_g2o_writes_them(tmp_path: Path) -> None:
    base = read_g2o(put(tmp_path, SE3 + f"EDGE_PRIOR_SE3:QUAT 1 0 3 0 0 0 0 0 1 {INFO3}\n"))
    for line in (f"EDGE_SE3_PRIOR 1 0 3 0 0 0 0 0 1 {INFO3}", f"EDGE_PRIOR_SE3 1 3 0 0 0 0 0 1 {INFO3}"):
        net = read_network(put(tmp_path, line + "\n" + SE3))
        assert np.array_equal(net.measurements, base.measurements)
    offset = SE3 + "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\nPARAMS_SE3OFFSET 4 0 0.5 0 0 0 0 1\n"
    assert np.array_equal(read_network(put(tmp_path, offset + line + "\n")).measurements, base.measurements)
    with pytest.raises(FormatError, match=r"f\.g2o:6.*sensor that is not at its vertex; got parameter 4"):
        read_network(put(tmp_path, offset + f"EDGE_SE3_PRIOR 1 4 3 0 0 0 0 0 1 {INFO3}\n"))


def test_long_quaternions_are_normalised_and_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    read_g2o(put(tmp_path, SE3))
    assert "quaternions" not in caplog.text
    net = read_g2o(put(tmp_path, SE3.replace("1.00001", "1.02")))
    assert net.poses[1, 6] == 1.0
    assert "quaternions of a length up to 2.0 % off 1 are normalised" in caplog.text
