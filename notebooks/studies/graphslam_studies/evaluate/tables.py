"""Statistics of a tidy Monte-Carlo table (``run, algorithm, submap, quantity, value``, in studies also ``world``)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import pandas as pd
from scipy import stats

from graphslam.core.errors import DataError
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.geometry import Array
from graphslam.evaluate.consistency import Consistency, Unit, consistency_index

_INDEX = ["algorithm", "quantity", "submap"]


def summarise(table: pd.DataFrame) -> pd.DataFrame:
    """Mean, standard error, median, extremes and number of runs per algorithm, quantity and submap.

    The median is there because means over few runs are ruled by the worst one.
    """
    groups = table.groupby(_INDEX, sort=True)["value"]
    out = groups.agg(["mean", "median", "std", "min", "max", "count"])
    out.insert(1, "standard_error", out["std"] / np.sqrt(out["count"]))
    return out.reset_index()


def values_of(table: pd.DataFrame, algorithm: str, quantity: str) -> tuple[Array, Array]:
    """Submap numbers ``(k,)`` and values ``(runs, k)`` of one curve; nan where a run has no figure."""
    rows = table[(table["algorithm"] == algorithm) & (table["quantity"] == quantity)]
    if rows.empty:
        raise DataError(f"table has no {quantity!r} of {algorithm!r}", wanted=sorted(set(table["quantity"])))
    if rows.duplicated(["run", "submap"]).any():
        raise DataError(f"{quantity!r} of {algorithm!r} is repeated in a run")
    wide = rows.pivot(index="run", columns="submap", values="value")
    return np.asarray(wide.columns, dtype=np.float64), wide.to_numpy(dtype=np.float64)


def consistency_of(
    table: pd.DataFrame,
    algorithm: str,
    quantity: str,
    *,
    dof: float,
    gauge: str,
    confidence: float = 0.95,
    unit: Unit = "run",
) -> tuple[Array, Consistency]:
    """Submap numbers and :class:`Consistency` of a NEES column."""
    submaps, values = values_of(table, algorithm, quantity)
    return submaps, Consistency(
        quantity=quantity, nees=values, dof=np.array(dof), gauge=gauge, confidence=confidence, unit=unit
    )


@dataclass(frozen=True, slots=True)
class PairedRatio:
    """How one algorithm compares with another over the same runs.

    Parameters
    ----------
    mean, half_width : float
        Mean of the per-run ratios a/b and 1.96 standard errors of it.
    geometric_mean : float
        Not ruled by single bad runs of b.
    factor : float
        The geometric mean times and divided by it is its 95 % interval, for ratios that are log-normal.
    wins, runs : int
        Runs in which a is smaller, and runs in all.
    """

    mean: float
    half_width: float
    geometric_mean: float
    factor: float
    wins: int
    runs: int


def paired_ratio(table: pd.DataFrame, quantity: str, a: str, b: str, *, submap: int = -1) -> PairedRatio:
    """Ratio of a positive figure of algorithms ``a`` and ``b``, run by run: runs differ far more than algorithms."""
    rows = table[(table["quantity"] == quantity) & (table["submap"] == submap)]
    wide = rows.pivot(index="run", columns="algorithm", values="value")
    for name in (a, b):
        if name not in wide:
            raise DataError(f"table has no {quantity!r} of {name!r}", wanted=sorted(wide.columns))
    pair = wide[[a, b]].dropna().to_numpy(dtype=np.float64)
    if len(pair) < 2:
        raise DataError(f"too few runs have both {a!r} and {b!r}", got=len(pair), wanted="at least 2")
    if np.any(pair <= 0):
        raise DataError(f"{quantity!r} is not positive in every run", got=float(pair.min()), wanted="> 0")
    ratio = pair[:, 0] / pair[:, 1]
    logs = np.log(ratio)
    return PairedRatio(
        mean=float(ratio.mean()),
        half_width=float(1.96 * ratio.std(ddof=1) / np.sqrt(len(ratio))),
        geometric_mean=float(np.exp(logs.mean())),
        factor=float(np.exp(1.96 * logs.std(ddof=1) / np.sqrt(len(logs)))),
        wins=int(np.sum(ratio < 1.0)),
        runs=len(ratio),
    )


def consistency_table(
    table: pd.DataFrame,
    quantity: str,
    *,
    dof: float | str,
    algorithms: Sequence[str] | None = None,
    submap: int | None = -1,
    confidence: float = 0.95,
    tolerance: float = 0.10,
) -> pd.DataFrame:
    """Is the mean over the runs what a consistent estimator would give? One row an algorithm (and world, and submap).

    A run counts once, whatever it averages over: errors of one run hang together (Combined SLAM eq. 18-20 with
    two-sided bounds of the mean).

    Parameters
    ----------
    quantity : str
        A NEES.
    dof : float or str
        Its degrees of freedom, or the quantity that holds them, for each run its own.
    algorithms : sequence of str, optional
        Which, in which order; default all that have the quantity, in order of name.
    submap : int or None
        -1: the whole run. None: one row for every submap.
    confidence : float
        Of the bounds, and 1 - α of CI.
    tolerance : float
        Relative distance from the bounds that still counts as ``near``.

    Returns
    -------
    DataFrame
        ``nees_over_n`` with ``low`` and ``high``, its two-sided bounds; mean and median CI with ``ci_low``, ``ci_high``
        and ``ci_consistent``, that of a consistent one (for differing dof, of their mean); ``inside`` the bounds, or
        ``near``; ``runs``, and ``missing``: runs whose figure is not a number. An infinite one stays, and rules a mean.
    """
    by = _keys(table)
    of_submap = table["submap"] >= 0 if submap is None else table["submap"] == submap
    rows = table[of_submap & (table["quantity"] == quantity)]
    if isinstance(dof, str):
        keys = [*by, "run", "submap"]
        n = table[of_submap & (table["quantity"] == dof)].set_index(keys)["value"]
        rows = rows.assign(dof=n.reindex(pd.MultiIndex.from_frame(rows[keys])).to_numpy())
        if rows["dof"].isna().any():
            raise DataError(f"a figure {quantity!r} has no {dof!r} beside it", wanted="one in the same run and submap")
    else:
        rows = rows.assign(dof=float(dof))
    out = []
    for key, group in _groups(rows, [*by, *(["submap"] if submap is None else [])], algorithms):
        known = group[group["value"].notna()]
        entry = {**key, "quantity": quantity, "runs": len(known), "missing": len(group) - len(known)}
        if len(known):
            entry |= _judge(known["value"].to_numpy(), known["dof"].to_numpy(), confidence, tolerance)
        out.append(entry)
    return pd.DataFrame(out)


def _judge(d2: Array, dof: Array, confidence: float, tolerance: float) -> dict[str, float | bool]:
    """Mean of independent NEES values against its bounds."""
    total, n = float(dof.sum()), float(dof.mean())
    low, high = (b / total for b in chi2_mean_bounds(total, 1, confidence))
    mean = float(d2.sum() / total)
    ci, scale = consistency_index(d2, dof, confidence=confidence), n / stats.chi2.ppf(confidence, n)
    return {
        "nees_over_n": mean,
        "low": low,
        "high": high,
        "ci_mean": float(ci.mean()),
        "ci_median": float(np.median(ci)),
        "ci_low": low * scale,
        "ci_high": high * scale,
        "ci_consistent": scale,
        "inside": low <= mean <= high,
        "near": low * (1.0 - tolerance) <= mean <= high * (1.0 + tolerance),
    }


def ratio_table(
    table: pd.DataFrame, quantities: Iterable[str], pairs: Iterable[tuple[str, str]], *, submap: int = -1
) -> pd.DataFrame:
    """:func:`paired_ratio` of each pair of algorithms in each world; pairs without two common runs are left out.

    Returns
    -------
    DataFrame
        ``world, quantity, a, b`` and the fields of :class:`PairedRatio`.
    """
    pairs = list(pairs)
    rows = table[(table["submap"] == submap) & table["value"].notna()]
    out = []
    for quantity in quantities:
        of_quantity = rows[rows["quantity"] == quantity]
        for world, group in of_quantity.groupby("world", sort=False) if "world" in table else [(None, of_quantity)]:
            runs = {name: set(g["run"]) for name, g in group.groupby("algorithm")}
            for a, b in pairs:
                if len(runs.get(a, set()) & runs.get(b, set())) < 2:
                    continue
                where = {} if world is None else {"world": world}
                ratio = asdict(paired_ratio(group, quantity, a, b, submap=submap))
                out.append({**where, "quantity": quantity, "a": a, "b": b, **ratio})
    return pd.DataFrame(out)


def coverage_table(
    table: pd.DataFrame, algorithms: Sequence[str] | None = None, *, confidence: float = 0.95
) -> pd.DataFrame:
    """Honesty of local maps, from ``local_joint_nees``, ``local_joint_dof`` and, where there, ``local_pose_nees``.

    Maps of one run use different data, so here the map is the unit.

    Returns
    -------
    DataFrame
        For each world and algorithm: number of ``maps``; ``joint`` NEES/n and ``pose`` NEES/3 with two-sided bounds;
        the share ``inside`` the ``confidence`` region with the bounds of a consistent one.
    """
    wide = table[table["quantity"].isin(["local_joint_nees", "local_joint_dof", "local_pose_nees"])]
    by = _keys(table)
    if not (wide["quantity"] == "local_joint_nees").any():
        raise DataError("table has no local maps", wanted="local_joint_nees and local_joint_dof")
    wide = wide.pivot(index=[*by, "run", "submap"], columns="quantity", values="value").reset_index()
    wide = wide.dropna(subset=["local_joint_nees", "local_joint_dof"])
    out = []
    for key, maps in _groups(wide, by, algorithms):
        d2, dof = maps["local_joint_nees"].to_numpy(), maps["local_joint_dof"].to_numpy()
        joint = _judge(d2, dof, confidence, 0.0)
        share = stats.binom(len(d2), confidence)
        a = (1.0 - confidence) / 2.0
        entry = {
            **key,
            "maps": len(d2),
            "joint": joint["nees_over_n"],
            "joint_low": joint["low"],
            "joint_high": joint["high"],
            "inside": float(np.mean(consistency_index(d2, dof, confidence=confidence) < 1.0)),
            "inside_low": float(share.ppf(a) / len(d2)),
            "inside_high": float(share.ppf(1.0 - a) / len(d2)),
        }
        if "local_pose_nees" in maps and maps["local_pose_nees"].notna().any():
            pose = maps["local_pose_nees"].dropna().to_numpy()
            found = _judge(pose, np.full(len(pose), 3.0), confidence, 0.0)
            entry |= {"pose": found["nees_over_n"], "pose_low": found["low"], "pose_high": found["high"]}
        out.append(entry)
    return pd.DataFrame(out)


def _keys(table: pd.DataFrame) -> list[str]:
    return [*(["world"] if "world" in table else []), "algorithm"]


def _groups(
    rows: pd.DataFrame, by: list[str], algorithms: Sequence[str] | None
) -> Iterable[tuple[dict[str, object], pd.DataFrame]]:
    """Groups with their keys; worlds as they come, algorithms in the order asked for."""
    rank = {name: k for k, name in enumerate(algorithms or sorted(set(rows["algorithm"])))}
    worlds = {w: k for k, w in enumerate(dict.fromkeys(rows["world"]))} if "world" in rows else {}
    found = []
    for key, group in rows.groupby(by, sort=True):
        named = dict(zip(by, key if isinstance(key, tuple) else (key,)))
        if named["algorithm"] in rank:
            found.append((worlds.get(named.get("world"), 0), rank[str(named["algorithm"])], named, group))
    return [(named, group) for _, _, named, group in sorted(found, key=lambda f: f[:2])]
