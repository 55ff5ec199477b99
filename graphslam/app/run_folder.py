"""The folder of a run: complete after a crash up to the last finished submap, resumable from there.

``config.toml`` (effective), ``run.json``, ``submaps/``, ``graph.g2o``, ``trajectory.tum``, ``nodes.tum``,
``landmarks.csv``, ``metrics.json``, ``events.jsonl``, ``association.npz``, ``figures/``; of submaps with evidence grids
``map.ply``, ``map.bt``, ``map-level0.pgm`` …, ``fused_map.json``.
"""

from __future__ import annotations

import json
import os
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from graphslam.app.config import dump_toml, read_toml
from graphslam.core.atomic import atomic_open
from graphslam.core.errors import ConfigError, RunFolderError
from graphslam.io.submap_store import GridLoader, SubmapStore


class RunFolder:
    """Creates, reopens and fills a run folder.

    Parameters
    ----------
    path : path
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @classmethod
    def start(cls, path: str | os.PathLike[str], config: Mapping[str, Any], *, resume: bool) -> RunFolder:
        """Make a new folder, or reopen one whose configuration is the same.

        Raises
        ------
        RunFolderError
            The folder holds something else, another configuration, or cannot be written.
        """
        folder = cls(path)
        text = dump_toml(config)
        make_folder(folder.path)
        old = folder.path / "config.toml"
        if old.is_file():
            if not resume:
                raise RunFolderError(
                    f"{folder.path}: holds a run already; --resume goes on with it, or choose another --out"
                )
            folder._check_same(old, config)
        elif any(folder.path.iterdir()):
            raise RunFolderError(f"{folder.path}: not empty and not a run folder; choose another --out")
        else:
            with atomic_open(old, "w") as stream:
                stream.write(text)
        sweep(folder.path)
        return folder

    @classmethod
    def new(cls, path: str | os.PathLike[str]) -> RunFolder:
        """Make a folder, or take one that is empty.

        Raises
        ------
        RunFolderError
            The folder holds something already, or cannot be made.
        """
        folder = cls(path)
        make_folder(folder.path)
        if any(folder.path.iterdir()):
            raise RunFolderError(f"{folder.path}: not empty; choose another --out")
        return folder

    def _check_same(self, old: Path, config: Mapping[str, Any]) -> None:
        """A resumed run must be the run that was stopped."""
        try:
            before = read_toml(old)
        except ConfigError as error:
            raise RunFolderError(f"{self.path}: damaged ({error})") from None
        for key, a, b in _differences(before, tomllib.loads(dump_toml(config))):
            raise RunFolderError(f"{self.path}: cannot resume, {key} was {a!r} and is {b!r} now")

    @property
    def submaps(self) -> SubmapStore:
        """Store of the finished submaps."""
        return self.submaps_with(None)

    def submaps_with(self, load_grid: GridLoader | None) -> SubmapStore:
        """Store of the finished submaps, whose grids are read too where a reader is given."""
        return SubmapStore(self.path / "submaps", load_grid=load_grid)

    @property
    def figures(self) -> Path:
        """Folder for PNG files, made when asked for."""
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        return folder

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file atomically; not-a-number becomes null."""
        with atomic_open(self.path / name, "w") as stream:
            stream.write(json.dumps(finite(value), indent=1, allow_nan=False) + "\n")

    def write_lines(self, name: str, rows: Iterable[Mapping[str, Any]]) -> None:
        """Write JSON lines atomically."""
        with atomic_open(self.path / name, "w") as stream:
            for row in rows:
                stream.write(json.dumps(finite(row), allow_nan=False) + "\n")

    def write_text(self, name: str, text: str) -> None:
        """Write a text file atomically."""
        with atomic_open(self.path / name, "w") as stream:
            stream.write(text)


def make_folder(path: Path) -> None:
    """Make a folder and those above it, unless it is there.

    Raises
    ------
    RunFolderError
        It cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(f"{path}: cannot be made ({error.strerror})") from None


def sweep(path: Path) -> None:
    """Remove the halves of files that a killed process left in a folder."""
    for part in path.rglob(".*.part"):
        part.unlink(missing_ok=True)


def finite(value: Any) -> Any:
    """The value with NumPy scalars as Python numbers and non-finite numbers as None (JSON has none)."""
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if hasattr(value, "tolist"):
        return finite(value.tolist())
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    return value


def _differences(a: Mapping[str, Any], b: Mapping[str, Any], where: str = "") -> Iterable[tuple[str, Any, Any]]:
    for key in sorted({*a, *b}):
        name = f"{where}.{key}" if where else key
        x, y = a.get(key), b.get(key)
        if isinstance(x, Mapping) and isinstance(y, Mapping):
            yield from _differences(x, y, name)
        elif x != y:
            yield name, x, y
