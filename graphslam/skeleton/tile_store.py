"""Measurements of a skeleton network in tiles on disk: a tile is a range of poses, named by the digest of its bytes.

A folder holds ``tiles.json`` and the tiles. A tile contains, little-endian: number of measurements of each pose
(int32), points (float32, three each), landmarks (int32). An existing tile is not written again, so writing can be
interrupted and repeated at any time, by one or several processes, and the folder is bitwise equal.
"""

from __future__ import annotations

import hashlib
import io
import mmap
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import atomic_open, read_json, sweep_parts, write_json
from graphslam.core.errors import DataError, FormatError, MissingDataError
from graphslam.core.npz import read_arrays
from graphslam.core.reading import check_regular

FORMAT = "graphslam.tiles/1"
_INDEX = "tiles.json"
_STEPS = 32
"""Number of ranges between two releases of mapped memory."""
_SHAPE = {
    "format": str,
    "landmarks": int,
    "tiles": [{"file": str, "poses": int, "measurements": int}],
}

Points = npt.NDArray[np.float32]
Labels = npt.NDArray[np.int32]
T = TypeVar("T", Points, Labels)


class Tiles:
    """Tiles of one network.

    Parameters
    ----------
    verify : bool
        Read every tile once and compare its digest with its name.

    Attributes
    ----------
    first : (N + 1,)
        First measurement of each pose.
    landmarks, measurements, size : int
        Number of landmarks and measurements, and number of poses of the largest tile.
    """

    def __init__(self, folder: str | Path, verify: bool = False) -> None:
        self.folder = Path(folder)
        where = self.folder / _INDEX
        index = read_json(where, fmt=FORMAT, shape=_SHAPE)
        if not index["tiles"]:
            raise FormatError("no tiles", where=str(where))
        self.landmarks = int(index["landmarks"])
        self._names = [str(t["file"]) for t in index["tiles"]]
        counts = []
        for tile in index["tiles"]:
            path = self._path(str(tile["file"]))
            n, m = int(tile["poses"]), int(tile["measurements"])
            if not path.is_file() or path.stat().st_size != 4 * n + 16 * m:
                got = f"{path.stat().st_size} bytes" if path.is_file() else "nothing"
                raise FormatError("tile is missing or truncated", where=str(path), got=got, wanted=f"{4 * n + 16 * m}")
            if verify and _digest(path.read_bytes()) != path.stem:
                raise FormatError("tile was changed: its digest is not its name", where=str(path))
            count = _numbers(path, np.empty(n, dtype="<i4"), 0)
            if count.min(initial=0) < 0 or int(count.sum()) != m:
                raise FormatError(
                    "measurements of the poses of a tile", where=str(path), got=int(count.sum()), wanted=m
                )
            counts.append(count)
        self._begin = np.concatenate([[0], np.cumsum([len(c) for c in counts])])
        self.first = np.concatenate([[0], np.cumsum(np.concatenate(counts), dtype=np.int64)]).astype(np.int64)
        self.measurements = int(self.first[-1])
        self.size = int(np.diff(self._begin).max())
        self._maps: weakref.WeakSet[mmap.mmap] = weakref.WeakSet()

    def _path(self, name: str) -> Path:
        if Path(name).name != name or not name.endswith(".tile"):
            raise FormatError("name of a tile", where=str(self.folder / _INDEX), got=name, wanted="a file beside it")
        return self.folder / name

    def ranges(self, begin: int, end: int) -> Iterator[tuple[int, int]]:
        """The poses ``begin … end - 1``, divided at tile boundaries."""
        met = 0
        for a, b in zip(self._begin[:-1], self._begin[1:]):
            if a < end and begin < b:
                if met % _STEPS == 0:
                    self.release()
                met += 1
                yield max(int(a), begin), min(int(b), end)

    def room(self, shape: tuple[int, ...], dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
        """A zero array on disk: a memory-mapped unnamed file in the folder, removed with the array.

        Its pages stay in memory until :meth:`release`, or until the system evicts them.
        """
        kind = np.dtype(dtype)
        size = int(np.prod(shape)) * kind.itemsize
        if not size:
            return np.zeros(shape, kind)
        with tempfile.TemporaryFile(dir=self.folder) as stream:
            stream.truncate(size)
            mapped = mmap.mmap(stream.fileno(), size)
        self._maps.add(mapped)
        return np.frombuffer(mapped, kind).reshape(shape)

    def release(self) -> None:
        """Free the memory pages of all arrays of :meth:`room`; their values are kept on disk."""
        if hasattr(mmap, "MADV_DONTNEED"):  # otherwise the system decides
            for mapped in list(self._maps):
                mapped.madvise(mmap.MADV_DONTNEED)

    def read(self, begin: int, end: int) -> tuple[Points, Labels]:
        """Points ``(m, 3)`` and landmarks ``(m,)`` of the poses ``begin … end - 1``."""
        points: list[Points] = []
        labels: list[Labels] = []
        for a, b in self.ranges(begin, end):
            k = int(np.searchsorted(self._begin, a, side="right")) - 1
            path = self._path(self._names[k])
            head = 4 * int(self._begin[k + 1] - self._begin[k])
            lo, hi = (int(self.first[i] - self.first[self._begin[k]]) for i in (a, b))
            m = int(self.first[self._begin[k + 1]] - self.first[self._begin[k]])
            points.append(_numbers(path, np.empty((hi - lo, 3), dtype="<f4"), head + 12 * lo))
            labels.append(_numbers(path, np.empty(hi - lo, dtype="<i4"), head + 12 * m + 4 * lo))
        if len(points) == 1:
            return points[0], labels[0]
        return np.concatenate(points), np.concatenate(labels)


def write_tiles(folder: str | Path, blocks: Iterable[tuple[npt.ArrayLike, Points, Labels]]) -> Tiles:
    """Write one tile per block, then the index.

    Parameters
    ----------
    folder : path
        Created if it does not exist. Existing tiles are kept.
    blocks : iterable of (counts (n,), points (m, 3), landmarks (m,))
        Measurements of each pose, in pose order; landmarks numbered by first observation over all blocks.
    """
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    sweep_parts(out)
    index, high = [], -1
    for number, (counts, points, landmark) in enumerate(blocks):
        n = np.ascontiguousarray(counts, dtype="<i4")
        z, label = np.ascontiguousarray(points, dtype="<f4"), np.ascontiguousarray(landmark, dtype="<i4")
        if z.shape != (len(label), 3) or int(n.sum()) != len(label):
            got = (int(n.sum()), z.shape, label.shape)
            raise DataError("a block of measurements contradicts itself", where=f"block {number}", got=got)
        if not np.isfinite(z).all() or (np.abs(z).max(axis=1, initial=0.0) < 1e-6).any():
            raise DataError("a measured point is not finite, or lies in the sensor", where=f"block {number}")
        peak = np.maximum.accumulate(np.concatenate([[high], label]))
        if label.min(initial=0) < 0 or (label > peak[:-1] + 1).any():
            raise DataError("landmarks are not numbered by first observation", where=f"block {number}")
        high = int(peak[-1])
        data = n.tobytes() + z.tobytes() + label.tobytes()
        name = f"{_digest(data)}.tile"
        path = out / name
        if not path.is_file() or path.stat().st_size != len(data):
            with atomic_open(path) as stream:
                stream.write(data)
        index.append({"file": name, "poses": len(n), "measurements": len(label)})
    write_json(out / _INDEX, {"format": FORMAT, "landmarks": high + 1, "tiles": index})
    return Tiles(out)


def store_arrays(folder: Path, arrays: Mapping[str, npt.ArrayLike]) -> str:
    """Write arrays to a file named by the digest of its bytes, unless it exists; returns its name."""
    stream = io.BytesIO()
    np.savez(stream, **{name: np.ascontiguousarray(value) for name, value in arrays.items()})  # type: ignore[arg-type]
    data = stream.getvalue()
    name = f"{_digest(data)}.arrays"
    if not (folder / name).is_file():
        with atomic_open(folder / name) as out:
            out.write(data)
    return name


def stored_arrays(folder: Path, name: str) -> dict[str, npt.NDArray[Any]]:
    """The arrays of such a file, after a check of its digest."""
    path = folder / name
    if path.name != name or path.suffix != ".arrays":
        raise FormatError("name of a file of arrays", where=str(folder), got=name, wanted="<digest>.arrays")
    if not path.is_file():
        raise MissingDataError("file of arrays is missing", where=str(path))
    check_regular(path)
    if _digest(path.read_bytes()) != path.stem:
        raise FormatError("file was changed: its digest is not its name", where=str(path))
    return read_arrays(path)


def _numbers(path: Path, out: T, begin: int) -> T:
    """``out``, filled from byte ``begin`` of a tile."""
    with path.open("rb") as stream:
        stream.seek(begin)
        got = stream.readinto(out.data)
    if got != out.nbytes:
        wanted = f"{out.nbytes} from byte {begin} on"
        raise FormatError("tile is truncated", where=str(path), got=f"{got} bytes", wanted=wanted)
    return out


def _digest(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()
