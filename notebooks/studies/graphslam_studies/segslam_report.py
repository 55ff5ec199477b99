"""Tables of the studies of grid front ends: errors by particles, run times, consistency of exits, loops, entropies.

Input is the tidy table of a study (``world, run, algorithm, submap, quantity, value``). Intervals are 95 %: Student for
means, Clopper–Pearson for shares, bootstrap over the runs for ratios and NEES.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd

from graphslam.core.gaussian import chi2_mean_bounds, chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam_studies.evaluate.intervals import grouped_mean_interval, mean_interval, ratio_of_means, share_interval
from graphslam_studies.montecarlo.worlds_study import whole
from graphslam_studies.segslam_trial import family_of

Row = dict[str, object]

PAPER_ERROR: Mapping[str, tuple[float, float]] = {
    "rbpf-1": (9.3, np.nan), "rbpf-5": (3.0, 6.9), "rbpf-10": (0.9, 4.5), "rbpf-20": (0.4, 3.8), "rbpf-40": (0.9, 1.5),
    "rbpf-100": (0.8, 1.1), "segslam-1": (0.7, np.nan), "segslam-5": (0.9, 0.6), "segslam-10": (0.7, 0.5),
    "segslam-20": (0.6, 0.2), "segslam-40": (0.5, 0.2),
}  # fmt: skip
"""Table II of the SegSLAM paper: mean and standard deviation of the error at the end of its garage over 20 runs [m]."""
PAPER_SECONDS: Mapping[str, float] = {
    "rbpf-1": 2.6, "rbpf-5": 11.0, "rbpf-10": 22.0, "rbpf-20": 47.0, "rbpf-40": 98.0, "rbpf-100": 280.0,
    "segslam-1": 4.2, "segslam-5": 13.0, "segslam-10": 26.0, "segslam-20": 41.0, "segslam-40": 83.0,
}  # fmt: skip
"""Table III of the paper: run time on its computer [s]."""
PAPER_ENTROPY: Mapping[str, float] = {"segslam-40": 10_755.0, "rbpf": 13_561.0}
"""Entropy in the building of the paper: SegSLAM with 40 particles, and best RBPF; only their ratio is comparable."""
GOOD = 1.5
"""A run with a smaller final error counts as loop closed [m]."""
COVARIANCES = {
    "exit_nees": "particles + drift",
    "exit_nees_stated": "particles + stated motion",
    "exit_nees_matched": "moment matching (paper)",
}


def values(table: pd.DataFrame, world: str, algorithm: str, quantity: str) -> Array:
    """One metric of every run ``(n,)``, in the order of the runs."""
    rows = whole(table, quantity)
    rows = rows[(rows["world"] == world) & (rows["algorithm"] == algorithm)].sort_values("run")
    return np.asarray(rows["value"], dtype=np.float64)


def cases(table: pd.DataFrame) -> Iterable[tuple[str, str]]:
    """Pairs of world and algorithm, in the order of the table."""
    rows = table[table["quantity"] == "failed"]
    yield from dict.fromkeys(zip(rows["world"].astype(str), rows["algorithm"].astype(str)))


def _rng(what: str) -> np.random.Generator:
    return SeedTree(0).child("report", what).generator()


def _mean(v: Array, name: str) -> Row:
    if not len(v):
        return {name: np.nan, f"{name}_low": np.nan, f"{name}_high": np.nan}
    mean, low, high = mean_interval(v)
    return {name: mean, f"{name}_low": low, f"{name}_high": high}


def error_table(table: pd.DataFrame) -> pd.DataFrame:
    """Table II: final error by algorithm and particles, with values of the paper; and the share of runs below `GOOD`.

    A failed run counts as not closed, and has no error.
    """
    out: list[Row] = []
    for world, name in cases(table):
        family, particles = family_of(name)
        e = values(table, world, name, "final_error")
        runs = len(values(table, world, name, "failed"))
        good = int(np.sum(e < GOOD))
        low, high = share_interval(good, runs)
        paper = PAPER_ERROR.get(name, (np.nan, np.nan)) if world.startswith("garage") else (np.nan, np.nan)
        row: Row = {"world": world, "algorithm": name, "family": family, "particles": particles, "runs": runs}
        row |= _mean(e, "mean")
        row |= {
            "std": float(e.std(ddof=1)) if len(e) > 1 else np.nan,
            "median": float(np.median(e)) if len(e) else np.nan,
            "max": float(e.max()) if len(e) else np.nan,
            "below": good / runs,
            "below_low": low,
            "below_high": high,
            "paper_mean": paper[0],
            "paper_std": paper[1],
        }
        out.append(row)
    return pd.DataFrame(out)


def ratio_table(table: pd.DataFrame, quantity: str = "final_error") -> pd.DataFrame:
    """Ratio of the means of SegSLAM and RBPF with equal numbers of particles, over the runs that both finished."""
    out: list[Row] = []
    names = list(cases(table))
    rows = whole(table, quantity)
    for world, name in names:
        family, particles = family_of(name)
        rival = f"rbpf-{particles}"
        if family != "segslam" or (world, rival) not in names:
            continue
        wide = rows[rows["world"] == world].pivot(index="run", columns="algorithm", values="value")
        if name not in wide or rival not in wide:
            continue
        pair = wide[[name, rival]].dropna().to_numpy(dtype=np.float64)
        if not len(pair) or pair[:, 1].mean() <= 0:
            continue
        ratio, low, high = ratio_of_means(pair[:, 0], pair[:, 1], _rng("ratio"))
        out.append({"world": world, "particles": particles, "runs": len(pair), "segslam": pair[:, 0].mean(),
                    "rbpf": pair[:, 1].mean(), "ratio": ratio, "low": low, "high": high})  # fmt: skip
    return pd.DataFrame(out)


def time_table(table: pd.DataFrame, timings: pd.DataFrame) -> pd.DataFrame:
    """Table III: run times [s], mean and minimum (least affected by other load on the machine), and their ratio."""
    out: list[Row] = []
    for world in dict.fromkeys(table["world"].astype(str)):
        recorded = values(table, world, "all", "seconds_recorded")
        numbers = sorted({family_of(a)[1] for w, a in cases(table) if w == world} - {0})
        for n in numbers:
            row: Row = {"world": world, "particles": n}
            least: dict[str, float] = {}
            for family in ("rbpf", "segslam"):
                seconds = values(timings, world, f"{family}-{n}", "seconds_total")
                if not len(seconds):
                    continue
                least[family] = float(seconds.min())
                row |= {family: float(seconds.mean()), f"{family}_least": least[family]}
                row[f"{family}_times_real_time"] = float(recorded.mean() / seconds.mean())
            if len(least) == 2:
                row["ratio_of_least"] = least["segslam"] / least["rbpf"]
            if world.startswith("garage"):
                a, b = (PAPER_SECONDS.get(f"{f}-{n}", np.nan) for f in ("segslam", "rbpf"))
                row |= {"paper_rbpf": b, "paper_segslam": a, "paper_ratio": a / b}
            out.append(row)
    return pd.DataFrame(out)


def nees_table(table: pd.DataFrame) -> pd.DataFrame:
    """Consistency of segment exits by covariance model: mean NEES per degree of freedom, 1 if consistent.

    ``low … high``: interval of the mean; segments of a run are treated as correlated. ``honest_low … honest_high``:
    bounds of this mean for independent, consistent exits. ``inside``: share in the 95 % region, over all segments.
    """
    out: list[Row] = []
    for world, name in cases(table):
        dof = values(table, world, name, "exit_dof")
        if not len(dof):
            continue
        n = float(dof[0])
        of = table[(table["world"] == world) & (table["algorithm"] == name)]
        for quantity, label in COVARIANCES.items():
            rows = of[of["quantity"] == quantity]
            d2 = rows["value"].to_numpy(dtype=np.float64)
            if not len(d2):
                continue
            mean, low, high = grouped_mean_interval(d2 / n, rows["run"].to_numpy(), _rng("nees"))
            a, b = chi2_mean_bounds(n, len(d2))
            inside = int(np.sum(d2 <= chi2_quantile(0.95, n)))
            row: Row = {"world": world, "algorithm": name, "covariance": label, "segments": len(d2)}
            row |= {"nees_over_n": mean, "low": low, "high": high, "median_over_n": float(np.median(d2) / n)}
            row |= {"honest_low": a / n, "honest_high": b / n, "inside": inside / len(d2)}
            out.append(row)
    return pd.DataFrame(out)


def exit_table(table: pd.DataFrame) -> pd.DataFrame:
    """RMS errors of segment exits: heading [rad], per axis in x, y [m], z [m]; and mean length [m]."""
    out: list[Row] = []
    for world, name in cases(table):
        of = table[(table["world"] == world) & (table["algorithm"] == name) & (table["submap"] >= 0)]
        e = {q: of[of["quantity"] == f"exit_{q}"]["value"].to_numpy(dtype=np.float64) for q in ("yaw", "x", "y", "z")}
        if not len(e["yaw"]):
            continue
        rms = {q: float(np.sqrt(np.mean(v**2))) for q, v in e.items()}
        row: Row = {"world": world, "algorithm": name, "segments": len(e["yaw"])}
        row |= {"length": float(of[of["quantity"] == "exit_length"]["value"].mean()), "yaw": rms["yaw"]}
        out.append(row | {"xy": float(np.hypot(rms["x"], rms["y"]) / np.sqrt(2.0)), "z": rms["z"]})
    return pd.DataFrame(out)


def match_table(table: pd.DataFrame) -> pd.DataFrame:
    """Matches with older maps: number, false ones, median error of the others; intervals per run."""
    out: list[Row] = []
    for world, name in cases(table):
        matches, false = (values(table, world, name, q) for q in ("matches", "false_matches"))
        if not len(matches):
            continue
        row: Row = {"world": world, "algorithm": name, "runs": len(matches), "matches": int(matches.sum())}
        row |= {
            "false_matches": int(false.sum()),
            "runs_with_false": int(np.sum(false > 0)),
            "runs_without_any": int(np.sum(matches == 0)),
            "intervals": float(values(table, world, name, "intervals").mean()),
        }
        offsets = values(table, world, name, "match_offset_median")
        row["offset_median"] = float(np.median(offsets)) if len(offsets) else np.nan
        merged = values(table, world, name, "merged_parallels")
        if len(merged):
            row["merged_parallels"] = int(merged.sum())
        out.append(row)
    return pd.DataFrame(out)


def means_table(table: pd.DataFrame, quantities: Iterable[str]) -> pd.DataFrame:
    """Means of metrics with Student's interval, one row per world and algorithm."""
    out: list[Row] = []
    for world, name in cases(table):
        row: Row = {"world": world, "algorithm": name, "runs": len(values(table, world, name, "failed"))}
        for q in quantities:
            v = values(table, world, name, q)
            if len(v):
                row |= _mean(v, q)
        out.append(row)
    return pd.DataFrame(out)


def seconds_table(timings: pd.DataFrame) -> pd.DataFrame:
    """Mean time of every part [s]."""
    rows = timings[timings["submap"] == -1]
    wide = rows.groupby(["world", "algorithm", "quantity"], sort=False)["value"].mean().unstack("quantity")
    return wide.reset_index()


def loop_table(table: pd.DataFrame, timings: pd.DataFrame) -> pd.DataFrame:
    """Loops: closed ones, runs that closed all, runs that merged no parallel sections, runs that did both.

    ``cost_growth``: time of a step in the last quarter of the run over that in the first.
    """
    out: list[Row] = []
    for world, name in cases(table):
        loops, closed = (values(table, world, name, q) for q in ("loops", "loops_closed"))
        every, merged = (values(table, world, name, q) for q in ("all_closed", "merged_parallels"))
        runs = len(values(table, world, name, "failed"))
        row: Row = {"world": world, "algorithm": name, "runs": runs, "loops": int(loops.sum())}
        row |= {"loops_closed": int(closed.sum()), "runs_all_closed": int(every.sum())}
        if len(merged):
            good = int(np.sum((every > 0) & (merged == 0)))
            low, high = share_interval(good, runs)
            row |= {
                "runs_never_merged": int(np.sum(merged == 0)),
                "runs_good": good,
                "good_low": low,
                "good_high": high,
            }
        row |= {"maps_megabytes": float(m.mean()) if len(m := values(table, world, name, "maps_megabytes")) else np.nan}
        first, last = (values(timings, world, name, f"seconds_step_{q}_quarter") for q in ("first", "last"))
        if len(first):
            row |= {"step_first_quarter": first.mean(), "step_last_quarter": last.mean(),
                    "cost_growth": last.mean() / first.mean()}  # fmt: skip
        out.append(row)
    return pd.DataFrame(out)


def entropy_table(table: pd.DataFrame, champion: str = "segslam-40") -> pd.DataFrame:
    """Minimum entropy over the map samples of a run [nat m³], and ratio of the means of the champion and of this one.

    ``ratio`` below 1: the map of the champion has less entropy. ``paper_ratio``: SegSLAM over best RBPF in the paper.
    """
    out: list[Row] = []
    rows = whole(table, "entropy_min")
    for world, name in cases(table):
        row: Row = {"world": world, "algorithm": name, "samples": float(np.max(values(table, world, name,
                    "entropy_samples"), initial=0.0))}  # fmt: skip
        row |= _mean(values(table, world, name, "entropy_min"), "entropy_min")
        wide = rows[rows["world"] == world].pivot(index="run", columns="algorithm", values="value")
        if champion in wide and name in wide and name != champion:
            pair = wide[[champion, name]].dropna().to_numpy(dtype=np.float64)
            if len(pair):
                ratio, low, high = ratio_of_means(pair[:, 0], pair[:, 1], _rng("entropy"))
                row |= {"ratio": ratio, "ratio_low": low, "ratio_high": high}
                row["champion_lower_in"] = int(np.sum(pair[:, 0] < pair[:, 1]))
        if name.startswith("rbpf") and world.startswith("building"):
            row["paper_ratio"] = PAPER_ENTROPY["segslam-40"] / PAPER_ENTROPY["rbpf"]
        out.append(row)
    return pd.DataFrame(out)
