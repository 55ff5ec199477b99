"""Submaps on disk: one npz per submap and an index, consistent after an interruption; same submaps, same bytes.

``submaps/000000.npz`` … contain the submaps (``graphslam.submap/2``), ``submaps/index.json`` lists them
(``graphslam.submaps/1``), ``truth.npz`` next to the folder contains ground truth, if known. The file of a submap is
written before the index, each under a temporary name that is then renamed. So after an interruption every submap in the
index has its file; there may be one more file, which is overwritten later.
"""

from __future__ import annotations

import itertools
import logging
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from graphslam.core.atomic import part_path, read_json, read_npz, sweep_parts, write_json, write_npz
from graphslam.core.dense import DensePayload
from graphslam.core.errors import DataError, FormatError, GeometryError, GraphSlamError, MissingDataError
from graphslam.core.map_truth import MapTruth
from graphslam.core.npz import check_arrays, floats, ints
from graphslam.core.reading import resolve_inside, safe_name
from graphslam.core.submap import Submap
from graphslam.io.submap_file import SUBMAP_FORMAT, submap_arrays, submap_from_arrays

logger = logging.getLogger(__name__)

INDEX_FORMAT = "graphslam.submaps/1"
INDEX = "index.json"
TRUTH = "truth.npz"

_NAME = re.compile(r"\d{6,}(\.grid)?\.npz")

GridLoader = Callable[[Path], DensePayload]


class SubmapStore:
    """A folder of submaps.

    Parameters
    ----------
    path : path
        The folder ``submaps/``, or its parent. It is created by the first :meth:`append`.
    load_grid : callable, optional
        Reads ``<name>.grid.npz``; without it, submaps are read without their grids.
    """

    def __init__(self, path: str | os.PathLike[str], *, load_grid: GridLoader | None = None) -> None:
        root = Path(path)
        inner = root / "submaps"
        self.path = inner if not (root / INDEX).is_file() and inner.is_dir() else root
        self._load_grid = load_grid
        self._entries: list[dict[str, Any]] | None = None

    @property
    def entries(self) -> list[dict[str, Any]]:
        """The index: key, file, interval and number of landmarks of each submap; empty if there is no index."""
        if self._entries is None:
            file = resolve_inside(self.path, INDEX, str(self.path))
            self._entries = _read_index(file) if file.exists() else []
        return self._entries

    def __len__(self) -> int:
        return len(self.entries)

    def __getitem__(self, k: int) -> Submap:
        """Submap at position k of the index (not with key k)."""
        entry = self.entries[k]
        file = resolve_inside(self.path, entry["file"], str(self.path / INDEX))
        submap = submap_from_arrays(read_npz(file, fmt=SUBMAP_FORMAT), where=str(file))
        found = {**_entry(submap), "file": entry["file"]}
        if found != entry:
            raise FormatError("index and file do not agree", where=str(file), got=found, wanted=entry)
        grid = file.with_suffix(".grid.npz")
        if self._load_grid is not None and grid.exists():
            submap = replace(submap, grid=self._load_grid(grid))
        return submap

    def __iter__(self) -> Iterator[Submap]:
        return (self[k] for k in range(len(self)))

    def read_all(self) -> list[Submap]:
        """Every submap of the index, in order."""
        return list(self)

    def append(self, submap: Submap) -> None:
        """Write one submap, then the extended index; keys must increase."""
        entries = self.entries
        if entries and submap.key <= entries[-1]["key"]:
            raise DataError(
                "submap key does not rise", where=str(self.path), got=submap.key, wanted=f"> {entries[-1]['key']}"
            )
        if entries and submap.dim != self._dim():
            raise DataError(f"submap {submap.key} is {submap.dim}-D", where=str(self.path), wanted=f"{self._dim()}-D")
        self.path.mkdir(parents=True, exist_ok=True)
        entry = _entry(submap)
        file = self.path / entry["file"]
        if submap.grid is not None:
            final = file.with_suffix(".grid.npz")
            temporary = part_path(final, ".npz")
            submap.grid.save(temporary)
            temporary.replace(final)
        write_npz(file, submap_arrays(submap))
        self._write_index([*entries, entry], submap.dim)

    def complete_prefix(self) -> list[Submap]:
        """All submaps before the first one that is missing, damaged, or different from the index.

        A resumed run can use them; temporary files and files that are not in the index are ignored.
        """
        whole: list[Submap] = []
        for k in range(len(self)):
            try:
                whole.append(self[k])
            except GraphSlamError as error:
                logger.warning("submap store ends after %d of %d submaps: %s", k, len(self), error)
                break
        return whole

    def truncate(self, count: int) -> None:
        """Delete all but the first ``count`` submaps, and files of an interrupted run that are not in the index.

        The index is written first, so that after an interruption every submap in it has its file.
        """
        kept = self.entries[:count]
        if not self.path.is_dir():
            return
        if len(kept) < len(self.entries):
            self._write_index(kept, self._dim())
        names = {e["file"] for e in kept} | {e["file"].replace(".npz", ".grid.npz") for e in kept}
        sweep_parts(self.path)
        for stray in self.path.glob("*.npz"):
            if stray.name not in names and _NAME.fullmatch(stray.name):
                stray.unlink(missing_ok=True)

    def _dim(self) -> int:
        return int(read_json(self.path / INDEX, fmt=INDEX_FORMAT)["dim"])

    def _write_index(self, entries: list[dict[str, Any]], dim: int) -> None:
        write_json(self.path / INDEX, {"format": INDEX_FORMAT, "dim": dim, "count": len(entries), "submaps": entries})
        self._entries = entries


def _entry(submap: Submap) -> dict[str, Any]:
    return {
        "key": int(submap.key),
        "file": f"{submap.key:06d}.npz",
        "interval": [float(t) for t in submap.interval],
        "landmarks": 0 if submap.landmarks is None else len(submap.landmarks),
    }


_INDEX = {
    "dim": int,
    "count": int,
    "submaps": [{"key": int, "file": str, "interval": (float, float), "landmarks": int}],
}
_TRUTH = {
    "keys": ints("m"),
    "exit_poses": floats("m", "p"),
    "landmark_ids": ints("n"),
    "landmarks": floats("n", "c"),
}


def _read_index(file: Path) -> list[dict[str, Any]]:
    index = read_json(file, fmt=INDEX_FORMAT, shape=_INDEX)
    entries: list[dict[str, Any]] = [
        {k: [float(t) for t in e[k]] if k == "interval" else e[k] for k in ("key", "file", "interval", "landmarks")}
        for e in index["submaps"]
    ]
    dim, count = index["dim"], index["count"]
    if count != len(entries) or dim not in (2, 3):
        raise FormatError("count or dim is wrong", where=str(file), got=(count, dim), wanted=(len(entries), "2 or 3"))
    for e in entries:
        safe_name(e["file"], str(file))
    keys = [e["key"] for e in entries]
    if any(b <= a for a, b in itertools.pairwise(keys)):
        raise FormatError("keys do not rise", where=str(file), got=keys)
    return entries


def read_submaps(path: str | os.PathLike[str], *, load_grid: GridLoader | None = None) -> list[Submap]:
    """All submaps of a store.

    Parameters
    ----------
    path : path
        The folder ``submaps/``, or its parent (a run folder).
    load_grid : callable, optional
        See :class:`SubmapStore`.
    """
    store = SubmapStore(path, load_grid=load_grid)
    if not (store.path / INDEX).is_file():
        raise MissingDataError("no submap store", where=str(path), wanted=f"a folder with {INDEX}, or its parent")
    return store.read_all()


def write_submaps(path: str | os.PathLike[str], submaps: list[Submap], *, truth: MapTruth | None = None) -> None:
    """Replace ``path/submaps/``, and write ``path/truth.npz`` with ground truth, if any."""
    store = SubmapStore(Path(path) / "submaps")
    store.truncate(0)
    for submap in submaps:
        store.append(submap)
    if truth is not None:
        write_truth(path, truth)


def write_truth(path: str | os.PathLike[str], truth: MapTruth) -> None:
    """Write ``path/truth.npz``, next to the folder ``submaps/``."""
    names = ("keys", "exit_poses", "landmark_ids", "landmarks")
    write_npz(Path(path) / TRUTH, {n: getattr(truth, n) for n in names})


def read_truth(path: str | os.PathLike[str]) -> MapTruth | None:
    """Ground truth of a store, or None if there is no file.

    Parameters
    ----------
    path : path
        The folder ``submaps/``, its parent, or the file.
    """
    root = Path(path)
    candidates = [root] if root.suffix == ".npz" else [root / TRUTH, root.parent / TRUTH]
    if root.suffix != ".npz" and not (root / INDEX).is_file():
        candidates = candidates[:1]  # a run folder: files next to it do not belong to it
    file = next((c for c in candidates if c.is_file()), None)
    if file is None:
        return None
    arrays = read_npz(file, fmt="none")
    if "landmarks" in arrays and arrays["landmarks"].size == 0:
        arrays["landmarks"] = arrays["landmarks"].reshape(0, 2)  # no landmarks: any dimension
    try:
        return MapTruth(**check_arrays(arrays, _TRUTH, str(file)))
    except GeometryError as error:
        raise GeometryError(error.what, where=str(file), got=error.got, wanted=error.wanted) from None
