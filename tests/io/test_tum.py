"""TUM trajectories: round trips, 2-D in the plane, and refusals that name the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.trajectory import Trajectory
from graphslam.io.tum import read_tum, write_tum
from tests.reference.groups import SE2, SE3

GOOD = "1.0 0 0 0 0 0 0 1"


def test_planar_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    poses = np.column_stack([rng.normal(size=(50, 2)) * 100, rng.uniform(-np.pi, np.pi, 50)])
    poses[0, 2], poses[1, 2] = np.pi, 0.0
    t = Trajectory(1.7e9 + np.cumsum(rng.uniform(0.01, 1, 50)), poses)
    write_tum(tmp_path / "a.tum", t)
    back = read_tum(tmp_path / "a.tum")
    assert back.dim == 2
    assert np.array_equal(back.times, t.times)
    assert np.array_equal(back.poses[:, :2], poses[:, :2])
    assert SE2.difference(back.poses, poses) < 1e-15 * 10


def test_spatial_round_trip(tmp_path: Path, rng: np.random.Generator) -> None:
    poses = se3.se3_exp(rng.normal(size=(50, 6)))
    t = Trajectory(np.arange(50.0), poses)
    write_tum(tmp_path / "a.tum", t)
    back = read_tum(tmp_path / "a.tum")
    assert back.dim == 3
    assert SE3.difference(back.poses, poses) < 1e-14
    assert np.array_equal(back.poses[:, :3], poses[:, :3])


def test_heading_is_a_rotation_about_z(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", Trajectory([1.5], [[2.0, 3.0, np.pi / 2]]))
    line = (tmp_path / "a.tum").read_text().splitlines()[-1]
    assert np.allclose([float(v) for v in line.split()], [1.5, 2, 3, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_planar_file_can_be_read_as_spatial_but_not_the_reverse(tmp_path: Path) -> None:
    p = tmp_path / "a.tum"
    p.write_text(GOOD + "\n")
    assert read_tum(p, dim=3).dim == 3
    p.write_text(GOOD + "\n2.0 0 0 0.1 0 0 0 1\n")
    assert read_tum(p).dim == 3
    with pytest.raises(FormatError, match=r"a\.tum:2: pose leaves the plane"):
        read_tum(p, dim=2)


def test_comments_blank_lines_and_rounded_quaternions(tmp_path: Path) -> None:
    p = tmp_path / "a.tum"
    p.write_text("# header\n\n  \n1.0 0 0 1 0.5001 0.4999 0.5 0.5002\n#2 0\n3.0 0 0 1 0 0 0 -1\n")
    t = read_tum(p)
    assert t.times.tolist() == [1.0, 3.0]
    assert np.allclose(np.linalg.norm(t.poses[:, 3:], axis=1), 1.0, atol=1e-15)


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("2.0 0 0 0 0 0 0", "wrong number of columns; got 7"),
        ("2.0 0 0 0 0 0 0 1 0.5", "wrong number of columns; got 9"),
        ("2.0 0 zero 0 0 0 0 1", "not a number"),
        ("2.0 0 nan 0 0 0 0 1", "not finite"),
        ("inf 0 0 0 0 0 0 1", "not finite"),
        ("2.0 0 0 0 0 0 0 0", "no unit quaternion"),
        ("2.0 0 0 0 0 0 0 1.2", "no unit quaternion"),
        ("1.0 0 0 0 0 0 0 1", "stamps do not increase"),
        ("0.5 0 0 0 0 0 0 1", "stamps do not increase"),
        ("2.0,0,0,0,0,0,0,1", "wrong number of columns"),
    ],
)
def test_malformed_line_is_refused_by_number(line: str, what: str, tmp_path: Path) -> None:
    p = tmp_path / "a.tum"
    p.write_text(f"# t x y z\n{GOOD}\n\n{line}\n9.0 0 0 0 0 0 0 1\n")
    with pytest.raises(FormatError, match=what) as error:
        read_tum(p)
    assert f"{p}:4" in str(error.value)


def test_missing_binary_and_empty_files(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        read_tum(tmp_path / "no.tum")
    (tmp_path / "b.tum").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(FormatError, match="not a text file"):
        read_tum(tmp_path / "b.tum")
    (tmp_path / "e.tum").write_text("# nothing\n")
    assert len(read_tum(tmp_path / "e.tum")) == 0


def test_a_repeated_stamp_costs_one_pose(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rows = [f"{0.1 * k:.1f} {k} 0 0 0 0 0 1" for k in range(40)]
    path = tmp_path / "a.tum"
    path.write_text("\n".join([*rows[:21], "2.0 77 0 0 0 0 0 1", *rows[21:]]) + "\n")
    read = read_tum(path)
    assert read.poses[:, 0].tolist() == list(range(40))
    assert "a.tum:22: 1 poses that repeat" in caplog.text


def test_the_number_of_a_pose_behind_it_is_left_out(tmp_path: Path) -> None:
    """As RTAB-Map writes it."""
    (tmp_path / "a.txt").write_text("#timestamp x y z qx qy qz qw id\n" + GOOD + " 1\n2.0 1 0 0 0 0 0 1 2\n")
    assert read_tum(tmp_path / "a.txt").poses.tolist() == [[0, 0, 0], [1, 0, 0]]


def test_stamps_out_of_order_are_reported_with_what_to_do(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text(GOOD + "\n0.5 0 0 0 0 0 0 1\n")
    with pytest.raises(FormatError, match=r"a\.tum:2: stamps do not increase; got 0\.5 after 1\.0; .*sort the file"):
        read_tum(tmp_path / "a.tum")
