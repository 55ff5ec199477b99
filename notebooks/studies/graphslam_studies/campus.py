"""The study ``campus``: effect of outdoor GPS fixes on the indoor map (Montemerlo and Thrun 2005, Figure 3).

Every run has a random campus and noise, computes the scan odometry once, and solves the same graph without fixes and
with them. The comparison is paired, so a sign test needs no other assumption.

Quantities
----------
``ate``, ``ate_indoor``, ``ate_outdoor``: after one alignment of the whole path [m]; ``ate_indoor_own``: indoor part
aligned separately; ``ate_indoor_anchored``: in the map frame, with the first base fixed. ``angle_error``: of the angle
between the two legs of a corridor [deg]. ``nees_<block>_<where>``: NEES per degree of freedom at one place of the
path; without ``<where>``: mean over the path.

All graphs of a run are aligned in the same way: ``ate`` and its parts with the true whole path, ``…_own`` with the true
indoor path, ``…_anchored`` with the first base, which is fixed in every graph. ``ate_indoor_world`` has no alignment:
indoor error in the campus frame, for graphs with fixes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from graphslam.core.gaussian import chi2_mean_bounds
from graphslam_studies import segslam_report as tables
from graphslam_studies.campus_moving import run_moving_trial
from graphslam_studies.campus_sessions import run_sessions_trial
from graphslam_studies.campus_trial import BLOCKS, KINDS, PAIRS, CampusTrialConfig, run_campus_trial
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs, whole
from graphslam_studies.sim.campus_config import campus_preset

_THIN = {"every": 3, "every_beam": 3}
_WIDE = {"size": (310.0, 310.0), "block": 90.0, "open_share": 0.7, "visits": 3, "round": False, "movers": 12, **_THIN}
WORLDS = {
    "blocks": CampusTrialConfig(campus=campus_preset("full", **_WIDE)),
    "block": CampusTrialConfig(campus=campus_preset("block", **_THIN)),
    "whole": CampusTrialConfig(campus=campus_preset("full", **{**_WIDE, "size": (600.0, 800.0), "movers": 20})),
}
"""``blocks``: 310 m × 310 m, path of 1.0 to 1.3 km through three buildings with few revisits; ``block``: one block,
around and through; ``whole``: the whole campus, 1.6 to 2.9 km."""
QUICK_WORLDS = {
    "quick": replace(WORLDS["block"], campus=campus_preset("quick", size=(66.0, 66.0), block=55.0, every=3, speed=1.5))
}
SESSIONS = {
    "sessions": CampusTrialConfig(
        campus=campus_preset("full", size=(70.0, 215.0), block=59.0, visits=1, open_share=1.0, movers=4, **_THIN)
    )
}
"""Three blocks in a row: two sessions around the first, one around the last."""
MOVING = {"moving": CampusTrialConfig(campus=campus_preset("quick", movers=8, **_THIN))}
"""One small block with eight cars and people, to count their voxels in the map."""
ERRORS = ("ate_indoor", "ate_indoor_own", "ate_indoor_anchored", "ate_outdoor", "ate", "end_error", "angle_error")
DRAWN = {"ate_indoor": "ATE inside, path aligned as a whole [m]", "angle_error": "corridor's angle off [°]"}
PLACES = ("middle", "indoor", "end")


class CampusStudy(WorldsStudy[CampusTrialConfig]):
    """See the module."""

    run_one = staticmethod(run_campus_trial)

    def worlds(self, quick: bool) -> tuple[str, ...]:
        """Worlds of the paired runs, of the sessions, and of moving objects."""
        return super().worlds(quick) + (() if quick else (*SESSIONS, *MOVING))

    def trial(self, world: str, quick: bool) -> Callable[[int], Iterable[Measurement]]:
        """See the base class."""
        if world in SESSIONS:
            return partial(run_sessions_trial, SESSIONS[world])
        return partial(run_moving_trial, MOVING[world]) if world in MOVING else super().trial(world, quick)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``errors``, ``pairs`` with and without fixes with sign tests, ``nees``, ``sessions``, ``moving``, ``cpu``."""
        pairs = table[~table["world"].isin((*SESSIONS, *MOVING))]
        out = {"errors": error_table(pairs), "pairs": pair_table(pairs), "nees": nees_table(pairs)}
        for name, worlds in (("sessions", SESSIONS), ("moving", MOVING)):
            if table["world"].isin(worlds).any():
                out[name] = mean_table(table, worlds)
        if not timings.empty:
            out["cpu"] = tables.seconds_table(timings)
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Errors of all runs."""
        return draw_runs(table, DRAWN, folder)


def error_table(table: pd.DataFrame) -> pd.DataFrame:
    """Mean over the runs of every error, one row per kind of graph."""
    out: list[tables.Row] = []
    for world in dict.fromkeys(table["world"].astype(str)):
        for kind in KINDS:
            row: tables.Row = {"world": world, "graph": kind}
            for quantity in (*ERRORS, "ate_indoor_world"):
                x = tables.values(table, world, kind, quantity)
                row |= {"runs": max(int(row.get("runs", 0)), len(x)), quantity: float(np.mean(x)) if len(x) else np.nan}  # type: ignore[call-overload]
            out.append(row)
    return pd.DataFrame(out)


def pair_table(table: pd.DataFrame) -> pd.DataFrame:
    """Every kind with fixes compared with the same graph without, run by run.

    ``ratio``: ratio of the means; ``median_ratio``: median of the ratios; ``half``: share of runs with half the error
    or less; ``p``: two-sided sign test of better against worse; ``p_half``: the same for half the error or less.
    """
    out: list[tables.Row] = []
    for world in dict.fromkeys(table["world"].astype(str)):
        for kind, plain in PAIRS.items():
            for quantity in ERRORS:
                rows = whole(table[table["world"] == world], quantity)
                wide = rows.pivot_table(index="run", columns="algorithm", values="value")
                if kind not in wide or plain not in wide:
                    continue
                wide = wide[[plain, kind]].dropna()
                a, b = wide[plain].to_numpy(), wide[kind].to_numpy()
                if not len(a):
                    continue
                better, differ = int(np.sum(b < a)), int(np.sum(b != a))
                row: tables.Row = {"world": world, "graph": kind, "quantity": quantity, "runs": len(a)}
                row |= {"without": float(a.mean()), "with_fixes": float(b.mean()), "ratio": float(b.mean() / a.mean())}
                row |= {"median_ratio": float(np.median(b / a)), "half": float(np.mean(b <= 0.5 * a)), "better": better}
                row["p"] = float(stats.binomtest(better, differ).pvalue) if differ else 1.0
                row["p_half"] = float(stats.binomtest(int(np.sum(b <= 0.5 * a)), len(a)).pvalue)
                out.append(row)
    return pd.DataFrame(out)


def nees_table(table: pd.DataFrame) -> pd.DataFrame:
    """NEES per degree of freedom at one place of each run, mean over the runs, with two-sided 95 % bounds."""
    out: list[tables.Row] = []
    for world in dict.fromkeys(table["world"].astype(str)):
        for kind in KINDS:
            for name, block in BLOCKS.items():
                dof = block.stop - block.start
                row: tables.Row = {"world": world, "graph": kind, "block": name}
                runs = 0
                for place in PLACES:
                    x = tables.values(table, world, kind, f"nees_{name}_{place}")
                    row[place] = float(np.mean(x)) if len(x) else np.nan
                    runs = max(runs, len(x))
                x = tables.values(table, world, kind, f"nees_{name}")
                row["whole_way"] = float(np.mean(x)) if len(x) else np.nan
                if runs:
                    low, high = chi2_mean_bounds(dof, runs)
                    row |= {"low": low / dof, "high": high / dof, "runs": runs}
                out.append(row)
    return pd.DataFrame(out)


def mean_table(table: pd.DataFrame, worlds: Iterable[str]) -> pd.DataFrame:
    """Mean over the runs of all metrics of some worlds; for binary ones this is the share."""
    rows = table[table["world"].isin(list(worlds)) & (table["quantity"] != "failed")]
    wide = rows.pivot_table(index="algorithm", columns="quantity", values="value", aggfunc="mean", sort=False)
    wide.insert(0, "runs", rows.groupby("algorithm")["run"].nunique())
    return wide.reset_index()


STUDY = CampusStudy(
    "campus",
    "fixes outside and corridors inside: paired graphs of one log, without GPS and with it",
    WORLDS,
    QUICK_WORLDS,
    trials=20,
)
