"""Control points, check points and measured distances: rows of a small table, each with its standard deviation.

A row measures a *place*: a point of the body at a time, or a landmark. It gives the coordinates of the place, or the
distance to another place. Columns, in any order; unused ones can be omitted:

* ``name``: of the row, for the ``to`` or ``place`` of other rows.
* ``place``: a time on the clock of the log [s], ``l17`` for landmark 17, or the name of another row.
* ``lever``: the measured point of the body in the body frame [m], numbers with spaces; empty: its origin.
* ``frame``: of the coordinates: ``survey``, a separate frame, or ``gps``, that of the fixes of the log.
* ``x``, ``y``, ``z``: coordinates [m]; or ``to``, ``distance``: another place, and the distance to it [m].
* ``sigma``: standard deviation [m], one number, or one per axis with spaces.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.core.errors import DataError, FormatError
from graphslam.core.geometry import Array
from graphslam.core.reading import LARGEST, read_text

COLUMNS = ("name", "place", "lever", "frame", "x", "y", "z", "to", "distance", "sigma")
FRAMES = ("survey", "gps")
CONTRADICTED = 5.0
"""Two rows of one place that differ by more than this number of standard deviations are both refused."""


@dataclass(frozen=True, slots=True)
class MeasuredPlace:
    """The measured place of a row: a point of the body at a time, or a landmark."""

    time: float | None = None
    landmark: int | None = None
    lever: tuple[float, ...] = ()

    def __str__(self) -> str:
        return f"l{self.landmark}" if self.time is None else f"{self.time:.3f} s"

    def arm(self, dim: int) -> Array:
        """The point in the body frame ``(dim,)`` [m]."""
        return np.array([*self.lever, 0.0, 0.0, 0.0][:dim])


@dataclass(frozen=True, slots=True, eq=False)
class ControlRow:
    """One row: coordinates of a place, or a distance between two.

    Parameters
    ----------
    line : int
        In its file.
    sigma : (1,) or (dim,)
        [m]
    position : (2,) or (3,), or None
        In ``frame`` [m].
    to : MeasuredPlace or None
        The other place of a ``distance`` [m].
    """

    line: int
    name: str
    place: MeasuredPlace
    sigma: Array
    frame: str = ""
    position: Array | None = None
    to: MeasuredPlace | None = None
    distance: float = math.nan

    def label(self) -> str:
        """``line 4 (gate)``."""
        return f"line {self.line}" + (f" ({self.name})" if self.name else "")

    def coordinates(self, dim: int) -> tuple[Array, Array]:
        """Coordinates ``(dim,)`` and their covariance ``(dim, dim)``; in 2-D without the height."""
        assert self.position is not None
        if len(self.position) < dim:
            raise DataError("a map in space needs a height", got="no z", wanted="x, y and z")
        sigma = np.broadcast_to(self.sigma, self.position.shape)[:dim]
        return self.position[:dim], np.diag(sigma**2)


@dataclass(frozen=True)
class ControlTable:
    """Usable and refused rows of a table.

    Parameters
    ----------
    source : str
        Name of the file.
    refused : list of (line, why)
    """

    source: str
    rows: list[ControlRow] = field(default_factory=list)
    refused: list[tuple[int, str]] = field(default_factory=list)

    @classmethod
    def parse(cls, source: str, lines: list[str]) -> ControlTable:
        """Read a table, header first; empty lines and those that begin with ``#`` are skipped."""
        numbered = [(k, t) for k, t in enumerate(lines, 1) if t.strip() and not t.lstrip().startswith("#")]
        cells = [[c.strip() for c in next(csv.reader([t]))] for _, t in numbered]
        header = [c.lower() for c in cells[0]] if cells else []
        unknown = [c for c in header if c not in COLUMNS]
        if unknown or len(set(header)) < len(header) or not {"place", "sigma"} <= set(header):
            wanted = f"columns of {', '.join(COLUMNS)}; place and sigma at least"
            raise FormatError("header of control points is not usable", where=source, got=header, wanted=wanted)
        out, found = cls(source), []
        for (line, _), given in zip(numbered[1:], cells[1:]):
            found.append((line, dict(zip(header, given)), len(given) - len(header)))
        names = _names(found)
        for line, row, more in found:
            try:
                if more > 0:
                    raise DataError("too many cells", got=len(header) + more, wanted=f"{len(header)}, as in the header")
                out.rows.append(_row(line, row, names))
            except DataError as error:
                out.refused.append((line, str(error)))
        for line, why in _contradictions(out.rows):
            out.refused.append((line, why))
        refused = {line for line, _ in out.refused}
        out.rows[:] = [r for r in out.rows if r.line not in refused]
        out.refused.sort()
        if not out.rows:
            text = "; ".join(f"line {line}: {why}" for line, why in out.refused[:5])
            raise DataError(f"no row can be used ({text or 'there is none'})", where=source, wanted="one row or more")
        return out


def measured_places(*tables: ControlTable | None) -> tuple[Array, Array] | None:
    """Times of places on the path, in order, and their lever ``(2,)``; of several levers the most frequent."""
    rows = [r for t in tables if t is not None for r in t.rows]
    places = [p for r in rows for p in (r.place, r.to) if p is not None and p.time is not None]
    levers = [p.lever for p in places]
    if not levers:
        return None
    lever = max(dict.fromkeys(levers), key=levers.count)
    times = np.unique([p.time for p in places if p.lever == lever and p.time is not None])
    return times, np.array([*lever, 0.0, 0.0][:2])


def control_lines(given: Any) -> dict[str, Any]:
    """Lines of a file, or of rows in memory, for storing them in a run folder.

    Parameters
    ----------
    given : path, table, or sequence of mapping
        A mapping contains the cells of a row by column; ``sigma`` and ``lever`` can be numbers or sequences.
    """
    if isinstance(given, (str, Path)):
        return {"source": Path(given).name, "rows": read_text(given).splitlines()}
    if isinstance(given, Mapping) and set(given) == {"source", "rows"}:
        return dict(given)
    rows = given.to_dict("records") if hasattr(given, "to_dict") else given
    if not isinstance(rows, (list, tuple)) or not all(isinstance(r, Mapping) for r in rows):
        wanted = "a file, a table, or a list of mappings of columns to cells"
        raise DataError("control points are not usable", got=type(given).__name__, wanted=wanted)
    header = list(dict.fromkeys(str(k) for r in rows for k in r))
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *([_cell(r.get(k)) for k in header] for r in rows)])
    return {"source": "rows", "rows": text.getvalue().splitlines()}


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, (list, tuple, np.ndarray)):
        return " ".join(repr(float(v)) for v in value)
    return str(value)


def _names(found: list[tuple[int, dict[str, str], int]]) -> dict[str, tuple[int, MeasuredPlace]]:
    """Line and place of the first row with each name."""
    names: dict[str, tuple[int, MeasuredPlace]] = {}
    for line, row, _ in found:
        name = row.get("name", "")
        if name and name not in names:
            try:
                names[name] = line, _place(row.get("place", ""), _numbers(row, "lever", (0, 2, 3)), {})
            except DataError:
                continue
    return names


def _number(row: Mapping[str, str], column: str) -> float:
    cell = row.get(column, "")
    try:
        value = float(cell)
    except ValueError:
        raise DataError(f"{column} is not a number", got=repr(cell), wanted="a number") from None
    if not (math.isfinite(value) and abs(value) <= LARGEST):
        raise DataError(f"{column} is not finite", got=cell, wanted="a number")
    return value


def _numbers(row: Mapping[str, str], column: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    cells = row.get(column, "").split()
    if len(cells) not in counts:
        wanted = " or ".join(map(str, counts)) + " numbers with spaces"
        raise DataError(f"{column} is not usable", got=repr(row.get(column, "")), wanted=wanted)
    return tuple(_number({column: c}, column) for c in cells)


def _place(cell: str, lever: tuple[float, ...], names: Mapping[str, tuple[int, MeasuredPlace]]) -> MeasuredPlace:
    if cell in names:
        return names[cell][1]
    if match := re.fullmatch(r"l(\d{1,18})", cell):
        return MeasuredPlace(landmark=int(match[1]))
    try:
        time = float(cell)
    except ValueError:
        time = math.nan
    if not (math.isfinite(time) and abs(time) <= LARGEST):
        wanted = "a time [s], l and the id of a landmark, or the name of a row"
        raise DataError("no place has this name", got=repr(cell), wanted=wanted)
    return MeasuredPlace(time=time, lever=lever if any(lever) else ())


def _row(line: int, row: Mapping[str, str], names: Mapping[str, tuple[int, MeasuredPlace]]) -> ControlRow:
    name = row.get("name", "")
    if name in names and names[name][0] != line:
        raise DataError("name is used twice", got=repr(name), wanted=f"another name than that of line {names[name][0]}")
    place = _place(row.get("place", ""), _numbers(row, "lever", (0, 2, 3)), names)
    coordinates = [c for c in "xyz" if row.get(c)]
    far = [c for c in ("to", "distance") if row.get(c)]
    if bool(coordinates) == bool(far):
        raise DataError("a row has coordinates or a distance", got=[*coordinates, *far], wanted="one of the two")
    if coordinates:
        position = np.array([_number(row, c) for c in ("xyz" if row.get("z") else "xy")])
        sigma = np.array(_numbers(row, "sigma", (1, len(position))))
        frame = row.get("frame") or FRAMES[0]
        if frame not in FRAMES:
            raise DataError("frame is not known", got=repr(frame), wanted=" or ".join(FRAMES))
        made = ControlRow(line, name, place, sigma, frame, position)
    else:
        to = _place(row.get("to", ""), (), names)
        sigma, distance = np.array(_numbers(row, "sigma", (1,))), _number(row, "distance")
        if to == place or not distance > 0:
            raise DataError("a distance is between two places", got=f"{place}, {to}: {distance:g} m", wanted="> 0 m")
        made = ControlRow(line, name, place, sigma, to=to, distance=distance)
    if not np.all(sigma > 0):
        raise DataError("sigma is not above 0", got=row.get("sigma"), wanted="a standard deviation [m] > 0")
    return made


def _contradictions(rows: list[ControlRow]) -> list[tuple[int, str]]:
    """Rows of one place, or of one pair of places, that contradict each other."""
    groups: dict[Any, list[ControlRow]] = {}
    for r in rows:
        key: Any = (r.place, r.frame) if r.to is None else frozenset([r.place, r.to])
        groups.setdefault(key, []).append(r)
    out = []
    for of in groups.values():
        for a, b in combinations(of, 2):
            if a.position is None or b.position is None:
                off = np.array([abs(a.distance - b.distance)])
            else:
                d = min(len(a.position), len(b.position))
                off = np.abs(a.position[:d] - b.position[:d])
            far = off > CONTRADICTED * np.hypot(a.sigma[: len(off)], b.sigma[: len(off)])
            if np.any(far):
                why = (
                    "it contradicts {}; got " + f"{off.max():.3g} m between them; wanted at most {CONTRADICTED:g} sigma"
                )
                out += [(a.line, why.format(b.label())), (b.line, why.format(a.label()))]
    return list(dict(reversed(out)).items())
