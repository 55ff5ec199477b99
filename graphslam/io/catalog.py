"""Recorded data by name: find it, check it, load it.

Files are looked for under the folders of the environment variable ``GRAPHSLAM_DATA``, then in the cache
(``GRAPHSLAM_CACHE``, or the platform's cache folder for graphslam), where :func:`graphslam.io.fetch.fetch` puts them.
"""

from __future__ import annotations

import hashlib
import importlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from graphslam.core.errors import DataError, FormatError, MissingDataError, UnknownNameError
from graphslam.io.cards import Card, CardFile, card, list_cards

DATA_VARIABLE = "GRAPHSLAM_DATA"
CACHE_VARIABLE = "GRAPHSLAM_CACHE"
State = Literal["ok", "missing", "differs"]


@dataclass(frozen=True, slots=True)
class Reader:
    """How a kind of folder is recognised and read.

    Parameters
    ----------
    target : str
        ``module:function``; the function takes the folder. Imported when used.
    markers : tuple of str
        A folder that holds one of these files is of this kind.
    parts : mapping of str to mapping
        Logs inside one data set, by the name that stands after the card's (``mrclam-dataset7/robot1``), and what the
        function is told for each.
    named : bool
        The function takes ``name``, which is then the card's: what presets are found by.
    """

    target: str
    markers: tuple[str, ...] = ()
    parts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    named: bool = False

    def __call__(self, path: Path, **options: Any) -> Any:
        module, _, function = self.target.partition(":")
        return getattr(importlib.import_module(module), function)(path, **options)


READERS: dict[str, Reader] = {
    "log-store": Reader("graphslam.io.log_store:load_log", ("log.json",)),
    "submap-store": Reader("graphslam.io.submap_store:read_submaps", ("index.json", "submaps/index.json")),
    "victoria-park": Reader("graphslam.io.victoria_park:read_victoria_park", ("LASER.txt.gz", "LASER.txt")),
    "slsjf-local-maps": Reader(
        "graphslam.io.slsjf:read_slsjf_local_maps", ("localmap_1.mat", "slsjf_200_local_maps/localmap_1.mat")
    ),
    "ufastslam-detections": Reader(
        "graphslam.io.victoria_park_published:read_ufastslam_detections",
        ("ufastslam_ObservationDistance.txt.gz", "ufastslam_ObservationDistance.txt"),
    ),
    "mrclam": Reader(
        "graphslam.io.mrclam:read_mrclam", ("Barcodes.dat",), {f"robot{k}": {"robot": k} for k in range(1, 6)}
    ),
    "plaza": Reader("graphslam.io.plaza:read_plaza", ("Plaza1_DR.txt.gz", "Plaza1_DR.txt")),
    "tuc": Reader("graphslam.io.tuc:read_tuc", ("Lecture_Hall_Input.txt.gz", "Lecture_Hall_Input.txt")),
    "euroc": Reader("graphslam.io.euroc:read_euroc", ("leica0_sensor.yaml",), named=True),
    "kitti-gps": Reader("graphslam.io.kitti_gps:read_kitti_gps", ("KittiGps_converted.txt",)),
    "smartloc": Reader(
        "graphslam.io.smartloc:read_smartloc",
        ("Berlin_Potsdamer_Platz_Input.txt.gz", "Berlin_Potsdamer_Platz_Input.txt"),
    ),
    "carmen": Reader(
        "graphslam.io.carmen:read_carmen", ("intel.clf.bz2", "fr079.clf.bz2", "mit-csail.clf.bz2"), named=True
    ),
    "lidar-pack": Reader(
        "graphslam.io.lidar_pack:read_lidar_pack", ("xyz_i16_planar.npy.xz", "xyz_i16_planar.npy"), named=True
    ),
}
"""Readers of folders by name. A pose network is a file: :func:`load` gives its path."""


def cache_folder() -> Path:
    """Where downloads go: ``GRAPHSLAM_CACHE``, or the platform's cache folder."""
    value = os.environ.get(CACHE_VARIABLE)
    if value:
        return Path(value)
    import pooch

    return Path(pooch.os_cache("graphslam"))


def data_roots() -> list[Path]:
    """Folders that are searched, in order: those of ``GRAPHSLAM_DATA``, then the cache."""
    value = os.environ.get(DATA_VARIABLE, "")
    return [*(Path(p) for p in value.split(os.pathsep) if p), cache_folder()]


def find_file(folder: Path, file: CardFile) -> Path | None:
    """The file below ``folder``, or its uncompressed form, or None."""
    names = (file.path, file.plain_path)
    return next((folder / n for n in names if n and (folder / n).is_file()), None)


def locate(data: Card | str) -> Path:
    """Folder that holds the data set's needed files.

    Raises
    ------
    UnknownNameError
        No such card.
    MissingDataError
        Says what is missing, where it was looked for and how to get it.
    """
    c = card(data) if isinstance(data, str) else data
    needed = [f for f in c.files if not f.optional]
    roots = data_roots()
    fewest: list[CardFile] = needed
    for root in roots:
        absent = [f for f in needed if find_file(root / c.folder, f) is None]
        if not absent:
            return root / c.folder
        fewest = min(fewest, absent, key=len)
    raise MissingDataError(
        f"{len(fewest)} of {len(needed)} files of data set {c.name!r} are missing, first {fewest[0].path}",
        where=os.pathsep.join(str(r / c.folder) for r in roots),
        wanted=f"run `graphslam data fetch {c.name}`"
        if c.fetchable
        else f"a copy from {c.source} (no direct download) in {c.folder}/ below a folder of {DATA_VARIABLE}",
    )


@dataclass(frozen=True, slots=True)
class FileCheck:
    """What :func:`check` found of one file."""

    file: CardFile
    state: State
    path: Path | None


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_file(folder: Path, file: CardFile) -> FileCheck:
    """Compare one file (or its uncompressed form) below ``folder`` with the card."""
    path = find_file(folder, file)
    if path is None:
        return FileCheck(file, "missing", None)
    packed = path == folder / file.path
    size, digest = (file.bytes, file.sha256) if packed else (file.content_bytes, file.content_sha256)
    same = path.stat().st_size == size and sha256_of(path) == digest
    return FileCheck(file, "ok" if same else "differs", path)


def check(data: Card | str) -> list[FileCheck]:
    """Compare every file with the card, in the first root that holds any of them.

    Raises
    ------
    UnknownNameError
        No such card.
    """
    c = card(data) if isinstance(data, str) else data
    folders = [root / c.folder for root in data_roots()]
    folder = next((d for d in folders if any(find_file(d, f) for f in c.files)), folders[-1])
    return [check_file(folder, f) for f in c.files]


def load(source: str | os.PathLike[str], **options: Any) -> Any:
    """Load recorded data by card name, or from a path.

    Parameters
    ----------
    source : str or path
        A card's name; ``card/file`` for one file of a card (the ending may be left out, as ``posegraphs/intel``);
        ``card/part`` where a set holds several logs (``mrclam-dataset7/robot1``); or an existing file or folder.
    options
        For the reader.

    Returns
    -------
    SensorLog, list of Submap, LandmarkObservations, TucLog or Path
        By the card's reader, or by what the folder holds. A pose network gives the path of its file, for
        :func:`graphslam.io.network_file.read_network`.

    Raises
    ------
    UnknownNameError
        Neither a card nor a path.
    MissingDataError
        The card's files are not on this machine.
    FormatError
        A folder that no reader knows.
    DataError
        A data set for which there is no reader.
    """
    text = os.fspath(source)
    known = {c.name for c in list_cards()}
    if text in known:
        c = card(text)
        if c.reader == "pose-network":
            return _only_file(c)
        if c.reader is None:
            raise DataError(f"there is no reader for data set {c.name!r}", where=str(locate(c)), got=c.kind)
        called = {"name": c.name} if READERS[c.reader].named else {}
        return READERS[c.reader](locate(c), **{**called, **c.options, **options})
    name, slash, part = text.partition("/")
    if slash and name in known and not Path(text).exists():
        c = card(name)
        parts = READERS[c.reader].parts if c.reader in READERS else {}
        if not parts:
            return _named_file(c, part)
        if part not in parts:
            raise UnknownNameError(f"part of data set {name!r}", part, parts)
        return READERS[str(c.reader)](locate(c), **{**c.options, **parts[part], **options})
    path = Path(text)
    if path.is_file():
        return path
    if path.is_dir():
        for reader in READERS.values():
            if any((path / m).is_file() for m in reader.markers):
                return reader(path, **options)
        raise FormatError(
            "no reader knows this folder",
            where=text,
            wanted="one of " + ", ".join(m for r in READERS.values() for m in r.markers),
        )
    raise UnknownNameError("data set or path", text, known)


def _only_file(c: Card) -> Path:
    if len(c.files) > 1:
        names = ", ".join(f"{c.name}/{_stem(f)}" for f in c.files)
        raise DataError(f"data set {c.name!r} holds {len(c.files)} files: name one", wanted=names)
    return _present(c, c.files[0])


def _named_file(c: Card, name: str) -> Path:
    for f in c.files:
        if name in (f.path, f.plain_path, _stem(f)):
            return _present(c, f)
    raise UnknownNameError(f"file of data set {c.name!r}", name, [_stem(f) for f in c.files])


def _present(c: Card, file: CardFile) -> Path:
    for root in data_roots():
        path = find_file(root / c.folder, file)
        if path is not None:
            return path
    locate(c)  # raises with what to do, unless only this optional file is missing
    raise MissingDataError("no such file", where=file.path, wanted=f"data set {c.name!r} complete")


def _stem(file: CardFile) -> str:
    """Path without its last two endings: ``intel.g2o.xz`` → ``intel``."""
    p = Path(file.plain_path or file.path)
    return p.with_suffix("").as_posix()
