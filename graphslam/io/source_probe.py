"""What a source looks like from outside: the names in a folder, and the beginnings of some of its files.

Readers tell by it whether a source is theirs. Nothing is decoded, and of each file no more than its beginning is read,
so that a folder with thousands of clouds is looked at in a moment.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from graphslam.core.errors import GraphSlamError
from graphslam.core.reading import read_bytes

COMPRESSIONS = (".gz", ".bz2", ".xz", ".zstd")
MOST_FILES, DEEPEST, HEAD, SAMPLE = 200_000, 5, 1 << 16, 6


@dataclass(frozen=True, slots=True)
class ReaderMatch:
    """What a reader says of a source.

    Parameters
    ----------
    found : str
        What it sees in it, with figures: ``"CARMEN log intel.clf: FLASER"``.
    missing : str
        Empty where it can read the source; else what is missing for that, and what would do.
    """

    found: str
    missing: str = ""


@dataclass
class SourceProbe:
    """A file or folder."""

    path: Path
    _heads: dict[Path, bytes] = field(default_factory=dict, repr=False)

    @cached_property
    def files(self) -> list[Path]:
        """The file itself; or those of the folder and of folders in it, sorted, hidden ones left out."""
        return [self.path] if self.path.is_file() else sorted(_walk(self.path))

    @cached_property
    def by_ending(self) -> dict[str, list[Path]]:
        """Files by their ending in small letters, that of a compression left out."""
        out: dict[str, list[Path]] = {}
        for p in self.files:
            out.setdefault(file_ending(p), []).append(p)
        return out

    def head(self, path: Path) -> bytes:
        """The first 64 kB of a file, decompressed; empty where it cannot be read."""
        if path not in self._heads:
            try:
                self._heads[path] = read_bytes(path, first=HEAD)[:HEAD]
            except GraphSlamError:
                self._heads[path] = b""
        return self._heads[path]

    def lines(self, path: Path, most: int = 200) -> list[str]:
        """The first whole lines of a text file that are not blank; none of a file that is no text."""
        raw = self.head(path)
        if b"\0" in raw[:4096]:
            return []
        rows = raw.decode("utf-8-sig", errors="replace").splitlines()
        if len(raw) == HEAD and len(rows) > 1:
            rows.pop()  # cut off
        return [r for r in rows if r.strip()][:most]

    @cached_property
    def texts(self) -> list[Path]:
        """Some files that are text: at most six of each ending in each folder."""
        seen: Counter[tuple[Path, str]] = Counter()
        out: list[Path] = []
        for p in self.files:
            key = (p.parent, file_ending(p))
            seen[key] += 1
            if seen[key] <= SAMPLE and len(out) < 100 and self.lines(p, 1):
                out.append(p)
        return out

    def named(self, *names: str) -> Path | None:
        """The first file of one of these names (small letters, compression left out), nearest to the top."""
        found = [p for p in self.files if plain_name(p) in names]
        return min(found, key=lambda p: (len(p.parts), names.index(plain_name(p)), p), default=None)

    def relative(self, path: Path) -> str:
        """Name of a file as seen from the source."""
        return path.name if self.path.is_file() else path.relative_to(self.path).as_posix()

    def __str__(self) -> str:
        if not self.files:
            return "an empty folder"
        if self.path.is_file():
            return f"the file {self.path.name} ({self.path.stat().st_size:,} bytes)"
        most = Counter({e: len(f) for e, f in self.by_ending.items()}).most_common(6)
        kinds = ", ".join(f"{n} {e or 'without ending'}" for e, n in most)
        return f"{len(self.files)} file{'s' if len(self.files) > 1 else ''} ({kinds})"


def _walk(root: Path) -> Iterator[Path]:
    count = 0
    for folder, inner, names in os.walk(root):
        depth = len(Path(folder).relative_to(root).parts)
        inner[:] = sorted(d for d in inner if not d.startswith(".")) if depth < DEEPEST else []
        for name in sorted(names):
            p = Path(folder) / name
            if not name.startswith(".") and p.is_file():
                count += 1
                if count > MOST_FILES:
                    return
                yield p


def plain_name(path: Path) -> str:
    """Name in small letters, the ending of a compression left out."""
    name = path.name.lower()
    return next((name[: -len(c)] for c in COMPRESSIONS if name.endswith(c)), name)


def file_ending(path: Path) -> str:
    """Ending in small letters, with its dot, that of a compression left out."""
    return Path(plain_name(path)).suffix
