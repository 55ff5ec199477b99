"""Line-by-line text files, plain or compressed: tagged records (g2o, TORO, iSAM) and plain tables of numbers.

The compression is told by the first bytes, not by the name, and every number that cannot be read is reported with
its file and line.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.reading import LARGEST, read_text

_WRITERS: dict[str, Callable[[bytes], bytes]] = {".xz": lzma.compress, ".gz": gzip.compress, ".bz2": bz2.compress}


def find_text_file(folder: str | os.PathLike[str], name: str) -> Path:
    """``name`` in ``folder``, plain or compressed.

    Raises
    ------
    MissingDataError
    """
    for ending in ("", *_WRITERS):
        path = Path(folder) / (name + ending)
        if path.is_file():
            return path
    endings = ", ".join(_WRITERS)
    raise MissingDataError("no such file", where=str(Path(folder) / name), wanted=f"{name}, plain or with {endings}")


def read_table(
    path: str | os.PathLike[str], columns: int, *, separator: str | None = None
) -> tuple[Array, npt.NDArray[np.int64]]:
    """Rows of ``columns`` numbers, one a line; blank lines and lines that begin with ``#`` are skipped.

    Parameters
    ----------
    path : path
    columns : int
    separator : str, optional
        What stands between numbers, and perhaps after the last one; white space by default.

    Returns
    -------
    values : (n, columns)
        Numbers may be NaN or infinite (also what is larger than :data:`~graphslam.core.reading.LARGEST`): the caller
        decides what to drop.
    lines : (n,) int64
        Line of every row, counted from 1, for messages.

    Raises
    ------
    MissingDataError
        No such file.
    FormatError
        A line with another number of values, or with something that is no number: names file and line.
    """
    rows: list[list[str]] = []
    lines: list[int] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split() if separator is None else line.strip().removesuffix(separator).split(separator)
        if not line.strip() or words[0].startswith("#"):
            continue
        if len(words) != columns:
            raise FormatError(
                "line is truncated or too long",
                where=f"{path}, line {number}",
                got=f"{len(words)} values: {line.strip()[:60]!r}",
                wanted=f"{columns} values",
            )
        rows.append(words)
        lines.append(number)
    try:
        values = np.array(rows, dtype=np.float64).reshape(-1, columns)
    except ValueError:
        k, word = next((k, w) for k, words in enumerate(rows) for w in words if not _is_number(w))
        raise FormatError("not a number", where=f"{path}, line {lines[k]}", got=repr(word[:40])) from None
    values[np.abs(values) > LARGEST] = np.inf  # as useless, and dropped or refused as such
    return values, np.array(lines, dtype=np.int64)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a file, compressed if its name ends in .xz, .gz or .bz2; a reader never sees half of it."""
    p = Path(path)
    data = text.encode("utf-8")
    if p.suffix in _WRITERS:
        data = _WRITERS[p.suffix](data)
    temporary = p.with_name(p.name + ".tmp")
    temporary.write_bytes(data)
    os.replace(temporary, p)


class Records:
    """Numbers of a text file by record tag, in file order.

    Parameters
    ----------
    path : path-like
    layouts : dict of str to tuple of int
        Tag → (leading integers, following floats). A line of a known tag must have exactly that many numbers;
        -1 integers means one or more and no floats.
    ignored : tuple of str
        Tags that are skipped.

    Attributes
    ----------
    rows : dict of str to list
        Tag → list of (line number, integers, floats).
    """

    def __init__(
        self, path: str | os.PathLike[str], layouts: dict[str, tuple[int, int]], *, ignored: tuple[str, ...] = ()
    ) -> None:
        self.path = str(path)
        self.rows: dict[str, list[tuple[int, list[int], list[float]]]] = {tag: [] for tag in layouts}
        for number, tokens in self._lines(read_text(path)):
            tag = tokens[0]
            if tag in ignored:
                continue
            if tag not in layouts:
                raise FormatError(
                    f"unknown record {tag[:40]!r}", where=self.where(number), wanted="one of " + ", ".join(layouts)
                )
            self.rows[tag].append((number, *self._numbers(number, tokens, *layouts[tag])))

    @staticmethod
    def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
        for number, line in enumerate(text.splitlines(), start=1):
            tokens = line.split()
            if tokens and not tokens[0].startswith("#"):
                yield number, tokens

    def _numbers(self, number: int, tokens: list[str], integers: int, floats: int) -> tuple[list[int], list[float]]:
        if integers < 0:
            integers = max(len(tokens) - 1, 1)
        if len(tokens) != 1 + integers + floats:
            raise FormatError(
                f"{tokens[0]} record is truncated or too long",
                where=self.where(number),
                got=f"{len(tokens) - 1} numbers",
                wanted=integers + floats,
            )
        try:
            whole = [int(t) for t in tokens[1 : 1 + integers]]
            real = [float(t) for t in tokens[1 + integers :]]
        except ValueError as error:
            raise FormatError(f"{tokens[0]} record holds no number ({error})", where=self.where(number)) from None
        for value in real:
            if not abs(value) <= LARGEST:
                raise FormatError(
                    f"{tokens[0]} record holds {value}",
                    where=self.where(number),
                    wanted=f"finite numbers, at most {LARGEST:g}",
                )
        for value in whole:
            if not 0 <= value < 2**62:
                raise FormatError("impossible vertex id", where=self.where(number), got=value, wanted="0 or more")
        return whole, real

    def where(self, number: int) -> str:
        """``file:line``."""
        return f"{self.path}:{number}"

    def __len__(self) -> int:
        return sum(len(r) for r in self.rows.values())


def tags_of(path: str | os.PathLike[str], limit: int = 100_000) -> set[str]:
    """The set of record tags among the first ``limit`` lines; for telling formats apart."""
    found: set[str] = set()
    for number, tokens in Records._lines(read_text(path)):
        if number > limit:
            break
        found.add(tokens[0])
    return found
