"""Data set descriptions: content, origin, terms and file checksums of a recorded data set.

A description is a TOML file in the folder ``datasets`` of the repository, which installs as ``graphslam/cards``; its
format is in ``datasets/README.md``. The data are not part of the package.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import graphslam
from graphslam.core.errors import FormatError, MissingDataError, UnknownNameError
from graphslam.core.markup import html_element, item_list, join_parts, pair_list
from graphslam.core.reading import read_text

CARD_FORMAT = "graphslam.card/1"
KINDS = ("sensor-log", "submaps", "detections", "pose-graph", "point-clouds", "octree")
_NAME = re.compile(r"[a-z0-9][a-z0-9-]*")
_SHA256 = re.compile(r"[0-9a-f]{64}")
COMPRESSIONS = (".gz", ".bz2", ".xz")


@dataclass(frozen=True, slots=True, kw_only=True)
class CardFile:
    """One file of a data set.

    Parameters
    ----------
    path : str
        Relative to the folder of the data set, with forward slashes.
    bytes, sha256 : int, str
        Size and checksum of the file ``path``.
    content_bytes, content_sha256 : int, str or None
        Size and checksum of the uncompressed file, which is also accepted; for ``.gz``, ``.bz2`` and ``.xz`` only.
    url : str or None
        Direct download of the file or, if there is a content checksum, of the uncompressed file.
    optional : bool
        The data set can be used without it.
    """

    path: str
    bytes: int
    sha256: str
    content_bytes: int | None = None
    content_sha256: str | None = None
    url: str | None = None
    optional: bool = False

    @property
    def plain_path(self) -> str | None:
        """Name of the uncompressed file, if its checksum is given."""
        return str(PurePosixPath(self.path).with_suffix("")) if self.content_sha256 else None


@dataclass(frozen=True, slots=True, kw_only=True)
class CardArchive:
    """A zip archive with files of the data set (found by name, in any folder of the archive)."""

    url: str
    members: tuple[str, ...]
    sha256: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """Description of a recorded data set.

    Parameters
    ----------
    kind : str
        One of :data:`KINDS`.
    folder : str
        Relative to a data root.
    records : str
        Content, as text.
    source, obtained_from : str
        The original page, and the source of our copy.
    caveats : tuple of str
        Known problems of the data.
    reader : str or None
        Name of a reader (:mod:`graphslam.io.readers`).
    plugin : str or None
        Python distribution with the reader, if it is not part of graphslam.
    options : mapping of str to float
        Options of the reader that its files do not contain.
    """

    name: str
    title: str
    kind: str
    folder: str
    records: str
    source: str
    obtained_from: str
    citation: str
    licence: str
    terms: str
    caveats: tuple[str, ...]
    files: tuple[CardFile, ...]
    archives: tuple[CardArchive, ...] = ()
    reader: str | None = None
    plugin: str | None = None
    options: Mapping[str, float] = field(default_factory=dict, hash=False)

    @property
    def bytes(self) -> int:
        """Size of all files."""
        return sum(f.bytes for f in self.files)

    def archive_of(self, file: CardFile) -> CardArchive | None:
        """The archive that contains a file, under its compressed or uncompressed name."""
        names = {PurePosixPath(p).name for p in (file.path, file.plain_path) if p}
        return next((a for a in self.archives if names & set(a.members)), None)

    @property
    def fetchable(self) -> bool:
        """Can every required file be downloaded directly?"""
        return all(f.url or self.archive_of(f) for f in self.files if not f.optional)

    def _repr_html_(self) -> str:
        rows = {
            "kind": self.kind,
            "holds": self.records,
            "source": self.source,
            "cite": self.citation,
            "licence": f"{self.licence}. {self.terms}",
            "files": f"{len(self.files)}, {self.bytes / 1e6:.1f} MB",
        }
        return join_parts([html_element("b", self.name), f": {self.title}", pair_list(rows), item_list(self.caveats)])


def cards_folder() -> Path:
    """Folder of the descriptions: in the installed package, or ``datasets`` next to it in a checkout."""
    package = Path(graphslam.__file__).resolve().parent
    for folder in (package / "cards", package.parent / "datasets"):
        if any(folder.glob("*.toml")):
            return folder
    raise MissingDataError("this installation has no data set descriptions", where=str(package / "cards"))


@cache
def list_cards() -> tuple[Card, ...]:
    """All data set descriptions, sorted by file name."""
    return tuple(read_card(p) for p in sorted(cards_folder().glob("*.toml")))


def find_card(name: str) -> Card:
    """The data set description with this name."""
    known = {c.name: c for c in list_cards()}
    if name not in known:
        raise UnknownNameError("data set", name, known)
    return known[name]


def read_card(path: Path) -> Card:
    """Read and check one data set description."""
    where = str(path)
    try:
        content = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as error:  # tomllib.TOMLDecodeError is a ValueError
        raise FormatError(f"not TOML ({error})", where=where) from None
    if content.pop("format", None) != CARD_FORMAT:
        raise FormatError("unknown format of a data set description", where=where, wanted=repr(CARD_FORMAT))
    files = tuple(_build(CardFile, f, where) for f in _list(content, "files", where))
    archives = tuple(_build(CardArchive, a, where) for a in _list(content, "archives", where))
    made: Card = _build(Card, {**content, "files": files, "archives": archives}, where)
    if not _NAME.fullmatch(made.name) or made.name != path.stem:
        raise FormatError(
            "name of the data set description differs from its file name", where=where, got=made.name, wanted=path.stem
        )
    if made.kind not in KINDS:
        raise FormatError("unknown kind", where=where, got=made.kind, wanted=", ".join(KINDS))
    if not files:
        raise FormatError("data set description without files", where=where)
    for p in (made.folder, *(f.path for f in files)):
        _check_path(p, where)
    for f in files:
        for digest, size in ((f.sha256, f.bytes), (f.content_sha256, f.content_bytes)):
            if (digest is None) != (size is None) or (digest is not None and not _SHA256.fullmatch(digest)):
                raise FormatError(
                    f"bad checksum of {f.path}", where=where, got=digest, wanted="64 hex digits and bytes"
                )
        if f.content_sha256 and not f.path.endswith(COMPRESSIONS):
            raise FormatError(f"{f.path} has a content but is not compressed", where=where)
    return made


def _check_path(path: str, where: str) -> None:
    p = PurePosixPath(path)
    if not path or "\\" in path or ":" in path or p.is_absolute() or ".." in p.parts:
        raise FormatError("path leaves the folder of the data set", where=where, got=path)


def _list(content: dict[str, Any], key: str, where: str) -> list[Any]:
    value = content.pop(key, [])
    if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
        raise FormatError(f"{key} is not a list of tables", where=where)
    return value


def _build(kind: Any, values: Mapping[str, Any], where: str) -> Any:
    """A dataclass from a table; its keys and types must match the fields."""
    wanted = {f.name: str(f.type) for f in fields(kind)}
    for key, value in values.items():
        if key not in wanted:
            raise FormatError(f"unknown key {key!r}", where=where, wanted=", ".join(wanted))
        text = wanted[key]
        good = (
            isinstance(value, list) and all(isinstance(v, str) for v in value)
            if text == "tuple[str, ...]"
            else isinstance(value, dict) and all(type(v) in (int, float) for v in value.values())
            if text.startswith("Mapping")
            else isinstance(value, tuple)
            if text.startswith("tuple")
            else isinstance(value, bool)
            if text == "bool"
            else isinstance(value, int) and not isinstance(value, bool) and value >= 0
            if text.startswith("int")
            else isinstance(value, str)
        )
        if not good:
            raise FormatError(f"{key} is not of type {text}", where=where, got=repr(value)[:80])
    try:
        return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})
    except TypeError as error:
        raise FormatError(f"data set description is incomplete ({error})", where=where) from None
