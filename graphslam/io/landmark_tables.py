"""Reader of odometry and landmark observations in two tables with headers: ``odometry.csv`` and ``observations.csv``.

Columns are identified by their names, in any order and case; units in brackets after a name are converted.

* odometry: ``t`` and either ``v``, ``w`` (forward speed and yaw rate, constant until the next record) or ``x``, ``y``,
  ``theta`` (pose in any fixed frame).
* observations: ``t``, ``range``, and ``bearing`` (0 ahead, positive to the left) or ``id`` (an integer) or both. Rows
  with the same stamp are one scan.

Values are separated by commas, semicolons, tabs or blanks; lines that begin with ``#`` or ``%`` are comments.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError, FormatError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.records import LandmarkObservations, Odometry, VelocityControls
from graphslam.io.clock import usable_records
from graphslam.io.odometry_noise import OdometryNoise
from graphslam.io.source_probe import ReaderMatch, SourceProbe
from graphslam.io.text_records import is_number

NAMES = {
    "t": ("t", "time", "stamp", "timestamp", "secs", "seconds"),
    "v": ("v", "vx", "speed", "velocity", "forward_velocity", "linear", "linear_velocity"),
    "w": ("w", "omega", "wz", "yaw_rate", "yawrate", "turn_rate", "angular", "angular_velocity", "ω"),
    "x": ("x", "px", "pos_x", "position_x"),
    "y": ("y", "py", "pos_y", "position_y"),
    "theta": ("theta", "th", "yaw", "heading", "phi", "θ"),
    "id": ("id", "landmark", "landmark_id", "tag", "tag_id", "marker", "beacon", "subject"),
    "range": ("range", "r", "dist", "distance"),
    "bearing": ("bearing", "b", "beta", "angle", "azimuth"),
}
UNITS = {
    "t": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3},
    "v": {"m/s": 1.0, "ms-1": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6},
    "angle": {"rad": 1.0, "deg": np.pi / 180.0, "°": np.pi / 180.0, "mrad": 1e-3},
    "w": {"rad/s": 1.0, "deg/s": np.pi / 180.0, "°/s": np.pi / 180.0},
}
_UNIT_OF = {"t": "t", "v": "v", "w": "w", "x": "length", "y": "length", "range": "length", "theta": "angle"}
_UNIT_OF["bearing"] = "angle"
ODOMETRY_HEADER = "t, v, w or t, x, y, theta"
OBSERVATIONS_HEADER = "t, range, and bearing or id or both"
RANGE_SIGMA, BEARING_SIGMA = 0.3, float(np.deg2rad(3.0))
"""Assumed σ of a range [m] and of a bearing [rad]; the tables contain none."""
NOISE = OdometryNoise((0.01, 0.005), (0.05, 0.02), 0.05)
"""Assumed noise of motions between the poses of a table."""
TABLE_ENDINGS = (".csv", ".txt", ".tsv", ".dat")
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Header:
    """Names of the columns of a table.

    Parameters
    ----------
    columns : dict of str to (int, float)
        Column index and factor to SI units, by the names in :data:`NAMES`.
    width : int
        Number of columns.
    line : int
        Line number of the header, counted from 1.
    text : str
        Text of the header.
    """

    columns: dict[str, tuple[int, float]]
    separator: str | None
    width: int
    line: int
    text: str

    @property
    def odometry(self) -> str:
        """``velocity``, ``pose`` or empty."""
        if {"t", "v", "w"} <= self.columns.keys():
            return "velocity"
        return "pose" if {"t", "x", "y", "theta"} <= self.columns.keys() else ""

    @property
    def detections(self) -> bool:
        """Is it a header of landmark observations?"""
        return {"t", "range"} <= self.columns.keys() and bool({"bearing", "id"} & self.columns.keys())


def separator_of(line: str) -> str | None:
    """Separator of the values of a line; None: white space."""
    return next((s for s in (";", "\t", ",") if s in line), None)


def header_of(line: str, number: int = 1) -> Header:
    """Columns identified by their names; columns with an unknown name or unit are ignored."""
    text = line.lstrip("#% ").rstrip()
    bare = re.sub(r"\s*[\[(]", "[", re.sub(r"[\])]", "]", text))  # "v [m/s]" and "v (m/s)" become "v[m/s]"
    sep = separator_of(bare)
    words = [w.strip().strip('"').lower() for w in (bare.split(sep) if sep else bare.split())]
    columns: dict[str, tuple[int, float]] = {}
    for k, word in enumerate(words):
        found = re.fullmatch(r"([^\[]+?)\s*(?:\[\s*([^\]]*?)\s*\])?", word)
        if found is None:
            continue
        name, unit = found[1].replace(" ", "_"), (found[2] or "").replace(" ", "")
        tail = re.fullmatch(r"(.+)_(s|ms|us|ns|m|cm|mm|rad|deg|m/s|rad/s|deg/s)", name)
        if not any(name in a for a in NAMES.values()) and tail and not unit:
            name, unit = tail[1], tail[2]
        ours = next((n for n, a in NAMES.items() if name in a), None)
        factors = UNITS.get(_UNIT_OF.get(ours or "", ""), {})
        if ours is None or ours in columns or (unit and factors and unit not in factors):
            continue
        columns[ours] = k, factors.get(unit, 1.0)
    return Header(columns, sep, len(words), number, text[:120])


def _header_in(lines: list[str]) -> Header | None:
    """Header of a table: the first known one, also in comments before the first row."""
    for number, line in enumerate(lines[:20], start=1):
        found = header_of(line, number)
        if found.odometry or found.detections:
            return found
        if line.strip() and not line.lstrip().startswith(("#", "%")):
            return None
    return None


def claim_tables(look: SourceProbe) -> ReaderMatch | None:
    """See :mod:`graphslam.io.recognise`."""
    motion, seen = _tables(look)
    guess = [p for p in look.files if re.match(r"(odom|landmark_obs|observation)", p.name.lower())]
    guess = [p for p in guess if p.suffix.lower() in TABLE_ENDINGS and look.lines(p, 1)]
    if motion and seen:
        return ReaderMatch(
            f"odometry ({look.relative(motion[0])}) and landmark observations ({look.relative(seen[0])})"
        )
    if motion or seen:
        have, lack = (motion[0], "observations") if motion else (seen[0], "odometry")
        header = OBSERVATIONS_HEADER if motion else ODOMETRY_HEADER
        bad = [p for p in guess if p != have]
        there = f"; the first line of {look.relative(bad[0])} is {look.lines(bad[0], 1)[0][:80]!r}" if bad else ""
        return ReaderMatch(
            f"a table of {'odometry' if motion else 'observations'}, {look.relative(have)}{there}",
            f"{lack}.csv beside it, with the header {header}",
        )
    if len({g.name.lower().startswith("odom") for g in guess}) == 2:
        heads = "; ".join(f"{look.relative(p)} begins {look.lines(p, 1)[0][:60]!r}" for p in guess[:2])
        return ReaderMatch(
            heads, f"a first line with names: odometry.csv {ODOMETRY_HEADER}; observations.csv {OBSERVATIONS_HEADER}"
        )
    return None


def _tables(look: SourceProbe) -> tuple[list[Path], list[Path]]:
    """Tables of odometry, and of observations; those with a matching file name first."""
    motion: list[Path] = []
    seen: list[Path] = []
    for e in TABLE_ENDINGS:
        for p in [q for q in look.by_ending.get(e, []) if q in look.texts]:
            header = _header_in(look.lines(p, 20))
            if header is not None:
                (seen if header.detections else motion).append(p)
    motion.sort(key=lambda p: ("odom" not in p.name.lower(), len(p.parts), p))
    seen.sort(key=lambda p: ("observation" not in p.name.lower(), len(p.parts), p))
    return motion, seen


def read_landmark_tables(
    path: str | os.PathLike[str],
    *,
    range_sigma: float = RANGE_SIGMA,
    bearing_sigma: float = BEARING_SIGMA,
    max_range: float | None = None,
    noise: OdometryNoise = NOISE,
) -> SensorLog:
    """Read the two tables.

    Parameters
    ----------
    path : path
        The folder with both tables.
    range_sigma, bearing_sigma : float
        σ of a range [m] and of a bearing [rad].
    max_range : float, optional
        Maximal range of the sensor [m]; default: the longest range in the table.
    noise : OdometryNoise
        Noise of motions between poses. The noise of velocities is an option of the front end.
    """
    root = Path(path)
    if not root.exists():
        raise MissingDataError("no such folder", where=str(root), wanted="odometry.csv and observations.csv in it")
    numbers = [range_sigma, bearing_sigma, 1.0 if max_range is None else max_range]
    if not all(np.isfinite(v) and v > 0 for v in numbers):
        raise ConfigError(f"landmark tables: σ and range {numbers}; wanted positive numbers")
    look = SourceProbe(root if root.is_dir() else root.parent)
    motion, seen = _tables(look)
    if not (motion and seen):
        claim = claim_tables(look)
        raise MissingDataError(
            "no odometry table in addition to the observation table",
            where=str(root),
            got=claim.found if claim else str(look),
            wanted=f"odometry.csv with the header {ODOMETRY_HEADER}, observations.csv with {OBSERVATIONS_HEADER}",
        )
    counter = DropCounter()
    controls, n_controls = _motion(motion[0], noise, counter)
    landmarks, n_seen = _observations(
        seen[0], (float(controls.times[0]), float(controls.times[-1])), range_sigma, bearing_sigma, max_range, counter
    )
    stream = "controls" if isinstance(controls, VelocityControls) else "odometry"
    lost = {
        k if k.startswith("landmarks: ") else f"{stream}: {k.partition(': ')[2]}": v for k, v in counter.counts.items()
    }
    return SensorLog(
        name=root.name,
        streams={stream: controls, "landmarks": landmarks},
        read={stream: n_controls, "landmarks": n_seen},
        dropped=lost,
        meta={"source": root.name, "range_sigma": range_sigma, "bearing_sigma": bearing_sigma},
    )


def _read(path: Path, stream: str, counter: DropCounter) -> tuple[dict[str, Array], Header]:
    """Columns by the names in :data:`NAMES`, in SI units; NaN where a value is missing."""
    lines = read_text(path).splitlines()
    header = _header_in(lines)
    if header is None:
        raise FormatError("has no header that is known", where=str(path), got=(lines or [""])[0][:80])
    rows: list[list[str]] = []
    short = 0
    for line in lines[header.line :]:
        bare = line.strip()
        if not bare or bare.startswith(("#", "%")):
            continue
        sep = header.separator if header.separator is None or header.separator in bare else separator_of(bare)
        words = [w.strip() for w in (bare.split(sep) if sep else bare.split())]
        if len(words) > header.width and not any(words[header.width :]):
            words = words[: header.width]
        if len(words) != header.width:
            short += 1
            continue
        rows.append(words)
    counter.drop(stream, "row with another number of values than the header", short)
    if short > 0.05 * (short + len(rows)):
        raise FormatError(
            f"{short} of {short + len(rows)} rows have not the {header.width} values of the header",
            where=str(path),
            got=header.text,
            wanted="one value a column",
        )
    out = {}
    for name, (k, factor) in header.columns.items():
        words = [r[k].strip('"') for r in rows]
        odd = [w for w in words if w and not is_number(w)]
        if 2 * len(odd) > len(words) and name == "id":  # text identities are numbered
            out[name] = np.unique(words, return_inverse=True)[1].astype(np.float64)
            continue
        if 2 * len(odd) > len(words):
            raise FormatError(
                f"{len(odd)} of {len(words)} values in the column of {name} are no numbers",
                where=str(path),
                got=repr(odd[0][:40]),
                wanted="numbers with a decimal point; times in seconds",
            )
        out[name] = np.array([_number(w) for w in words]) * factor
    return out, header


def _number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        return float("nan")
    return value if abs(value) <= 1e30 else float("nan")


def _in_order(a: dict[str, Array], stream: str, counter: DropCounter) -> dict[str, Array]:
    """Sort the rows by time if more than 2 % of the stamps decrease; fewer are dropped later."""
    t = a["t"]
    back = int(np.sum(np.diff(t) < 0))
    if back <= 0.02 * len(t):
        return a
    counter.drop(stream, "rows were not in order of time: sorted (kept)", back)
    order = np.argsort(np.where(np.isfinite(t), t, -np.inf), kind="stable")
    return {k: v[order] for k, v in a.items()}


def _motion(path: Path, noise: OdometryNoise, counter: DropCounter) -> tuple[VelocityControls | Odometry, int]:
    a, header = _read(path, "odometry", counter)
    n = len(a["t"])
    kind = header.odometry
    a = _in_order(a, "odometry", counter)
    names = ("v", "w") if kind == "velocity" else ("x", "y", "theta")
    bad = {
        "a number is missing or not finite": np.asarray(
            ~finite_mask(np.column_stack([a[k] for k in names])).all(axis=1)
        )
    }
    keep = usable_records(a["t"], bad, stream="odometry", where=str(path), drops=counter)
    if keep.sum() < 2:
        raise DataError("holds too few records", where=str(path), got=int(keep.sum()), wanted="2 or more")
    t = a["t"][keep]
    if kind == "velocity":
        return VelocityControls(times=t, speed=a["v"][keep], yaw_rate=a["w"][keep]), n
    return noise.odometry(t, np.column_stack([a[k][keep] for k in names])), n


def _observations(
    path: Path,
    span: tuple[float, float],
    range_sigma: float,
    bearing_sigma: float,
    max_range: float | None,
    counter: DropCounter,
) -> tuple[LandmarkObservations, int]:
    a, header = _read(path, "landmarks", counter)
    n = len(a["t"])
    if n == 0:
        raise DataError("no observations", where=str(path), wanted="at least one row below the header")
    t, r, b = a["t"], a["range"], a.get("bearing", np.zeros(n))
    ids = a.get("id")
    good = np.ones(n, dtype=np.bool_)
    for reason, wrong in (
        ("stamp, range or bearing is missing or not finite", ~(finite_mask(t) & finite_mask(r) & finite_mask(b))),
        ("range is not positive", ~(r > 0)),
        ("stamp outside the time of the odometry", ~((span[0] <= t) & (t <= span[1]))),
    ):
        counter.drop("landmarks", reason, int((good & wrong).sum()))
        good &= ~wrong
    if good.sum() < 0.5 * n:
        usual = t[np.isfinite(t)]
        raise DataError(
            f"{int((~good).sum())} of {n} observations are unusable",
            where=str(path),
            got=f"{dict(counter.counts)}; stamps {usual.min() if len(usual) else np.nan:.3f} to "
            f"{usual.max() if len(usual) else np.nan:.3f} s, odometry {span[0]:.3f} to {span[1]:.3f} s",
            wanted="finite numbers on one clock, in seconds",
        )
    rows = np.flatnonzero(good)
    rows = rows[np.argsort(t[rows], kind="stable")]
    stamps, start = np.unique(t[rows], return_index=True)
    named: Ints | None = None
    if ids is not None:
        whole = np.isfinite(ids) & (ids == np.round(ids)) & (np.abs(ids) < 2**53)
        named = np.where(whole & (ids >= 0), np.where(whole, ids, 0), -1).astype(np.int64)[rows]
    offsets = np.append(start, len(rows)).astype(np.int64)
    reach = max_range or float(r[rows].max())
    if "bearing" not in header.columns:
        seen = LandmarkObservations.range_only(
            times=stamps, offsets=offsets, ranges=r[rows], range_sigma=range_sigma, ids=named, max_range=reach
        )
        return seen, n
    b = b[rows]
    if np.abs(b).max() <= 2 * np.pi + 1e-6:  # larger ones are probably degrees, which `data check` reports
        b = np.arctan2(np.sin(b), np.cos(b))
    return LandmarkObservations(
        times=stamps,
        offsets=offsets,
        ranges=r[rows],
        bearings=b,
        sigmas=np.tile([range_sigma, bearing_sigma], (len(rows), 1)),
        ids=named,
        max_range=reach,
        field_of_view=(float(min(b.min(), -1e-3)), float(max(b.max(), 1e-3))),
    ), n
