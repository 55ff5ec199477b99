"""Text files, plain or compressed: tagged records (g2o, TORO, iSAM) and tables of numbers.

Compression is detected from the first bytes when a file is read; errors contain file and line of an unreadable number.
"""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from graphslam.core.atomic import atomic_open
from graphslam.core.errors import FormatError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.reading import LARGEST, finite_mask, read_text

_WRITERS: dict[str, Callable[[bytes], bytes]] = {
    ".xz": lzma.compress,
    ".gz": partial(gzip.compress, mtime=0),
    ".bz2": bz2.compress,
}


def find_text_file(folder: str | os.PathLike[str], name: str) -> Path:
    """``name`` in ``folder``, plain or compressed."""
    for ending in ("", *_WRITERS):
        path = Path(folder) / (name + ending)
        if path.is_file():
            return path
    endings = ", ".join(_WRITERS)
    raise MissingDataError("no such file", where=str(Path(folder) / name), wanted=f"{name}, plain or with {endings}")


def read_table(
    path: str | os.PathLike[str], columns: int, *, separator: str | None = None, skip: int = 0
) -> tuple[Array, npt.NDArray[np.int64]]:
    """Rows of ``columns`` numbers, one per line; blank lines and lines that begin with ``#`` are skipped.

    Parameters
    ----------
    separator : str, optional
        Separator of the numbers, also allowed after the last one; default: white space.
    skip : int
        Number of header lines.

    Returns
    -------
    values : (n, columns)
        Numbers may be NaN or infinite; values above :data:`~graphslam.core.reading.LARGEST` become infinite. The caller
        decides what to drop.
    lines : (n,) int64
        Line number of each row, counted from 1, for error messages.
    """
    rows: list[list[str]] = []
    lines: list[int] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.split() if separator is None else line.strip().removesuffix(separator).split(separator)
        if number <= skip or not line.strip() or words[0].startswith("#"):
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
        k, word = next((k, w) for k, words in enumerate(rows) for w in words if not is_number(w))
        raise FormatError("not a number", where=f"{path}, line {lines[k]}", got=repr(word[:40])) from None
    values[np.abs(values) > LARGEST] = np.inf  # rejected or dropped by the caller like infinite values
    return values, np.array(lines, dtype=np.int64)


def is_number(word: str) -> bool:
    """Is the word a number for ``float``?"""
    try:
        float(word)
    except ValueError:
        return False
    return True


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a file atomically, compressed if its name ends in .xz, .gz or .bz2."""
    p = Path(path)
    data = text.encode("utf-8")
    if p.suffix in _WRITERS:
        data = _WRITERS[p.suffix](data)
    with atomic_open(p) as stream:
        stream.write(data)


@dataclass(frozen=True, slots=True)
class Rows:
    """All records of one tag, in file order.

    Parameters
    ----------
    lines : (n,) int64
        Line number of each record, counted from 1.
    whole : (n, integers) int64
    real : (n, floats) float64
    """

    lines: npt.NDArray[np.int64]
    whole: npt.NDArray[np.int64]
    real: Array

    def __len__(self) -> int:
        return len(self.lines)


class Records:
    """Numbers of a text file by record tag, in file order, as arrays.

    Parameters
    ----------
    path : path-like
    text : str
        Content of the file.
    layouts : dict of str to tuple of int
        Tag → (leading integers, following floats). A line with a known tag must have exactly this many numbers;
        -1 integers: one or more and no floats, each of which becomes a separate row.
    ignored : tuple of str
        Tags that are skipped.
    aliases : dict of str to str
        Alternative tag → tag in ``layouts``.
    implied : dict of str to tuple
        Tag → (index, words): inserted at the index into a line that is shorter by the number of words.

    Attributes
    ----------
    rows : dict of str to Rows
    not_read : Counter of str
        Number of lines of the ignored tags.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        text: str,
        layouts: dict[str, tuple[int, int]],
        *,
        ignored: tuple[str, ...] = (),
        aliases: Mapping[str, str] = MappingProxyType({}),
        implied: Mapping[str, tuple[int, list[str]]] = MappingProxyType({}),
    ) -> None:
        self.path, self.not_read = str(path), Counter[str]()
        # Packed numbers, not lists of objects: a file may hold a million edges.
        raw = {
            tag: (array("q"), array("q"), array("d"), integers, 1 + integers + floats)
            for tag, (integers, floats) in layouts.items()
        }
        for number, tokens in tagged_lines(text):
            tokens[0] = aliases.get(tokens[0], tokens[0])
            if tokens[0] not in raw:
                if tokens[0] in ignored:
                    self.not_read[tokens[0]] += 1
                    continue
                raise FormatError(
                    f"unknown record {tokens[0][:40]!r}",
                    where=self.where(number),
                    wanted="one of " + ", ".join(layouts),
                )
            lines, whole, real, integers, length = raw[tokens[0]]
            each = integers < 0
            if each:
                integers, length = len(tokens) - 1, max(len(tokens), 2)
            at, words = implied.get(tokens[0], (0, []))
            if words and len(tokens) + len(words) == length:
                tokens[at:at] = words
            if len(tokens) != length:
                raise FormatError(
                    f"{tokens[0]} record is truncated or too long",
                    where=self.where(number),
                    got=f"{len(tokens) - 1} numbers",
                    wanted=length - 1,
                )
            try:
                whole.extend(map(int, tokens[1 : 1 + integers]))
                real.extend(map(float, tokens[1 + integers :]))
            except ValueError as error:
                raise FormatError(
                    f"{tokens[0]} record holds no number ({error})",
                    where=self.where(number),
                    wanted="numbers with a decimal point",
                ) from None
            except OverflowError:
                self._impossible(number, next(t for t in tokens[1:] if not 0 <= int(t) < 2**63))
            if each:
                lines.extend([number] * integers)
            else:
                lines.append(number)
        self.rows = {tag: self._checked(tag, *parts[:3], *layouts[tag]) for tag, parts in raw.items()}

    def _checked(self, tag: str, lines: array[int], whole: array[int], real: array[float], k: int, f: int) -> Rows:
        n = len(lines)
        rows = Rows(
            np.array(lines, dtype=np.int64),
            np.array(whole, dtype=np.int64).reshape(n, abs(k)),
            np.array(real, dtype=np.float64).reshape(n, f),
        )
        bad = np.flatnonzero(~finite_mask(rows.real).all(axis=1))
        if len(bad):
            value = next(v for v in rows.real[bad[0]].tolist() if not abs(v) <= LARGEST)
            raise FormatError(
                f"{tag} record holds {value}",
                where=self.where(int(rows.lines[bad[0]])),
                wanted=f"finite numbers, at most {LARGEST:g}",
            )
        bad = np.flatnonzero((rows.whole < 0).any(axis=1))
        if len(bad):
            value = next(v for v in rows.whole[bad[0]].tolist() if v < 0)
            self._impossible(int(rows.lines[bad[0]]), value)
        return rows

    def _impossible(self, number: int, got: object) -> NoReturn:
        raise FormatError(
            "impossible vertex id",
            where=self.where(number),
            got=got,
            wanted="whole numbers from 0 to 2⁶³ - 1",
        )

    def where(self, number: int) -> str:
        """``file:line``."""
        return f"{self.path}:{number}"


def tagged_lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Line number, counted from 1, and words before a ``#``, for each line with words."""
    for number, line in enumerate(text.splitlines(), start=1):
        tokens = line.partition("#")[0].split()
        if tokens:
            yield number, tokens
