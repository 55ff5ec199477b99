"""A network in tiles on disk is the network in memory, to the byte; and a killed writer leaves nothing wrong."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.skeleton.preconditioner import PreconditionerLevels
from graphslam.skeleton.problem import SkeletonProblem
from graphslam.skeleton.relax import RelaxConfig, relax_skeleton
from graphslam.skeleton.tile_store import Tiles, write_tiles
from graphslam.skeleton.tiles import load_tiled_problem, write_tiled_problem
from graphslam_studies.sim.laps import Laps


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


@pytest.mark.parametrize("size", [7, 16, 40, 1000])
def test_a_run_in_tiles_is_the_run_in_memory(problem: SkeletonProblem, tmp_path: Path, size: int) -> None:
    tiled = write_tiled_problem(problem, tmp_path / "tiles", size)
    assert len(tiled.points) == 0
    assert (tiled.landmarks, tiled.measurements, tiled.freedom) == (
        problem.landmarks,
        problem.measurements,
        problem.freedom,
    )
    for levels in (PreconditionerLevels(4, 16), PreconditionerLevels(10, 12)):
        config = RelaxConfig(levels=levels, split=False, iterations=3)
        a, b = relax_skeleton(problem, config), relax_skeleton(tiled, config)
        assert a.poses.position.tobytes() == b.poses.position.tobytes()
        assert a.poses.rotation.tobytes() == b.poses.rotation.tobytes()
        assert a.landmarks.tobytes() == b.landmarks.tobytes()
        assert [h.objective for h in a.history] == [h.objective for h in b.history]
        assert (a.refused, a.soft) == (b.refused, b.soft)


def test_room_on_disk_keeps_its_numbers_and_leaves_no_file(problem: SkeletonProblem, tmp_path: Path) -> None:
    tiled = write_tiled_problem(problem, tmp_path, 30)
    assert tiled.tiles is not None
    names = sorted(p.name for p in tmp_path.iterdir())
    room = tiled.room((300_000, 3))
    assert not room.any()
    room[:] = np.arange(900_000.0).reshape(-1, 3)
    before = _mapped()
    tiled.tiles.release()
    if before is not None:  # 7.2 MB were mapped, and are let go of
        assert _mapped() < before - 5_000
    np.testing.assert_array_equal(room, np.arange(900_000.0).reshape(-1, 3))
    assert tiled.room((0, 3)).shape == (0, 3)
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    assert problem.room((4, 3)).base is None  # in memory it is an array like any other


def _mapped() -> int | None:
    """Mapped files of this process in memory [kB], where the system tells."""
    status = Path("/proc/self/status")
    found = (
        [w.split()[1] for w in status.read_text().splitlines() if w.startswith("RssFile")] if status.exists() else []
    )
    return int(found[0]) if found else None


def test_a_world_is_drawn_to_disk_as_in_memory(problem: SkeletonProblem, laps: Laps, tmp_path: Path) -> None:
    tiles = laps.to_tiles(tmp_path)
    points, landmark = tiles.read(0, problem.poses)
    assert points.tobytes() == problem.points.tobytes()
    assert landmark.tobytes() == problem.landmark.tobytes()
    drawn = laps.problem(tiles=tiles)
    assert drawn.odometry_translation.tobytes() == problem.odometry_translation.tobytes()
    assert drawn.landmarks == problem.landmarks


def test_what_needs_all_measurements_at_once_says_so(problem: SkeletonProblem, tmp_path: Path) -> None:
    tiled = write_tiled_problem(problem, tmp_path, 30)
    with pytest.raises(ConfigError, match="split"):
        relax_skeleton(tiled)
    with pytest.raises(ConfigError, match="blocks"):
        relax_skeleton(tiled, RelaxConfig(method="blocks", split=False))


WRITE = """
import sys
from pathlib import Path
from graphslam_studies.sim.laps import LapsConfig, draw_laps
from graphslam.skeleton import tile_store
from graphslam.skeleton.tiles import write_tiled_problem

folder, stop = Path(sys.argv[1]), int(sys.argv[2])
real, written = tile_store.atomic_open, []

def counted(path, *rest):
    if len(written) == stop:  # killed in the middle of a file
        import os, signal
        from graphslam.core.atomic import part_path
        part_path(Path(path)).write_bytes(b"half a tile")
        os.kill(os.getpid(), signal.SIGKILL)
    written.append(path)
    return real(path, *rest)

tile_store.atomic_open = counted
write_tiled_problem(draw_laps(LapsConfig(poses=96, laps=4, begin=3, reach=5), seed=3).problem(), folder, 20)
"""


def test_a_killed_writer_changes_no_byte(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole", tmp_path / "killed"

    def write(folder: Path, stop: int) -> int:
        command = [sys.executable, "-c", WRITE, str(folder), str(stop)]
        return subprocess.run(command, check=False, env=os.environ, cwd=Path(__file__).parents[2]).returncode

    assert write(whole, -1) == 0
    assert len(bytes_of(whole)) == 6
    assert write(killed, 2) == -9
    left = bytes_of(killed)
    assert len(left) == 3  # two tiles and half of one, and no index: no network yet
    with pytest.raises(MissingDataError):
        Tiles(killed)
    assert write(killed, -1) == 0
    assert bytes_of(killed) == bytes_of(whole)


def test_damaged_folders_are_refused(problem: SkeletonProblem, tmp_path: Path) -> None:
    write_tiled_problem(problem, tmp_path, 30)
    Tiles(tmp_path, verify=True)
    index = tmp_path / "tiles.json"
    good = index.read_text()
    name = json.loads(good)["tiles"][1]["file"]
    tile = (tmp_path / name).read_bytes()
    changed = bytearray(tile)
    changed[500] ^= 1
    (tmp_path / name).write_bytes(changed)
    with pytest.raises(FormatError, match="digest"):
        Tiles(tmp_path, verify=True)
    (tmp_path / name).write_bytes(tile[:-4])
    with pytest.raises(FormatError, match="truncated"):
        Tiles(tmp_path)
    (tmp_path / name).write_bytes(tile)
    for text, words in (
        (good.replace("tiles/1", "tiles/9"), "tiles/9"),
        (good.replace(name, "../" + name), "name of a tile"),
        (good[:-5], "JSON"),
    ):
        index.write_text(text)
        with pytest.raises(FormatError, match=words):
            Tiles(tmp_path)
    index.write_text(good)
    # a folder of another network does not fit the odometry
    other = write_tiles(tmp_path / "other", [([1, 1], np.ones((2, 3), np.float32), np.array([0, 0], np.int32))])
    with pytest.raises(DataError):
        load_tiled_problem(problem, other)
    with pytest.raises(DataError, match="first observation"):
        write_tiles(tmp_path / "more", [([1], np.ones((1, 3), np.float32), np.array([4], np.int32))])
