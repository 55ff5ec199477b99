"""Overview of a source: file names of a folder, and the first bytes of some files.

Readers use it to recognise their sources. Only the first bytes of a file are read, so that a folder with thousands of
clouds is checked quickly.
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
    """Result of a reader's check of a source.

    Parameters
    ----------
    found : str
        Description of the source: ``"CARMEN log intel.clf: FLASER"``.
    missing : str
        Empty if the reader can read the source; otherwise what is missing.
    """

    found: str
    missing: str = ""


@dataclass
class SourceProbe:
    """A file or folder, with cached access to its names and first bytes."""

    path: Path
    _heads: dict[Path, bytes] = field(default_factory=dict, repr=False)

    @cached_property
    def files(self) -> list[Path]:
        """The file itself; or the files of the folder and of its subfolders, sorted, without hidden ones."""
        return [self.path] if self.path.is_file() else sorted(_walk(self.path))

    @cached_property
    def by_ending(self) -> dict[str, list[Path]]:
        """Files by their extension in lower case, without that of a compression."""
        out: dict[str, list[Path]] = {}
        for p in self.files:
            out.setdefault(file_ending(p), []).append(p)
        return out

    def head(self, path: Path) -> bytes:
        """The first 64 kB of a file, decompressed; empty if it cannot be read."""
        if path not in self._heads:
            try:
                self._heads[path] = read_bytes(path, first=HEAD)[:HEAD]
            except GraphSlamError:
                self._heads[path] = b""
        return self._heads[path]

    def lines(self, path: Path, most: int = 200) -> list[str]:
        """The first complete lines of a text file, without blank ones; empty if it is no text file."""
        raw = self.head(path)
        if b"\0" in raw[:4096]:
            return []
        rows = raw.decode("utf-8-sig", errors="replace").splitlines()
        if len(raw) == HEAD and len(rows) > 1:
            rows.pop()  # incomplete
        return [r for r in rows if r.strip()][:most]

    @cached_property
    def texts(self) -> list[Path]:
        """Text files among the first six of each extension in each folder; at most 100."""
        seen: Counter[tuple[Path, str]] = Counter()
        out: list[Path] = []
        for p in self.files:
            key = (p.parent, file_ending(p))
            seen[key] += 1
            if seen[key] <= SAMPLE and len(out) < 100 and self.lines(p, 1):
                out.append(p)
        return out

    def named(self, *names: str) -> Path | None:
        """The first file with one of these names (lower case, without compression extension), nearest to the top."""
        found = [p for p in self.files if plain_name(p) in names]
        return min(found, key=lambda p: (len(p.parts), names.index(plain_name(p)), p), default=None)

    def relative(self, path: Path) -> str:
        """Path of a file relative to the source."""
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
    """Name in lower case, without the extension of a compression."""
    name = path.name.lower()
    return next((name[: -len(c)] for c in COMPRESSIONS if name.endswith(c)), name)


def file_ending(path: Path) -> str:
    """Extension in lower case, with its dot, without that of a compression."""
    return Path(plain_name(path)).suffix
