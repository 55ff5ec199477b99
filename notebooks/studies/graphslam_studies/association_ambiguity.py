"""The study ``association-ambiguity``: particle filters and EKFs with unknown data association.

Worlds: ``clutter`` (false and missed observations), ``pairs`` (every feature has a close neighbour), ``rows`` (an
avenue, with motion noise of a quarter of its period per scan), ``hard`` (avenue, pairs, clutter, missed observations).

Algorithms
----------
``known``: identities given, in the local maps and in the join (lower bound). ``ekf-nn``, ``ekf-jcbb``: EKF local maps
with gated nearest neighbour, with joint compatibility; ``…-smoothed``: the latter, output after smoothing.
``rbpf-N``: FastSLAM 2.0 local maps with per-particle maximum likelihood, smoothed under the winning association;
``rbpf1-N`` the same with the proposal of FastSLAM 1.0, where every particle samples its pose *before* association;
``rbpf-paper``: moment matching instead of smoothing. ``ekf-slam-nn``, ``ekf-slam-jcbb``: a single map. All have the
same noise model, confirmation rule and cuts; all local maps are joined by joint compatibility and polished.

Quantities
----------
Inside the submaps: ``wrong_share``: share of output observations that differ from the majority identity of their
landmark; ``used_share``: share of true observations that are in the right landmark; per submap ``local_landmarks``, and
of these ``local_spurious`` (clutter), ``local_duplicated``; ``local_missed`` features seen three times without a
landmark; ``local_pair_precision`` and ``local_pair_recall`` of observations; ``local_pose_nees`` (3 DoF).
Between them: ``merges`` of landmarks of two submaps, ``wrong_merges``, ``wrong_merge_share``, ``missed_merge_share``.
Of the final map: ``pair_precision``, ``pair_recall`` over the whole run, ``end_error`` [m], ``end_nees``, ``diverged``
(``end_nees`` beyond 5 σ, or no map at all), ``pose_rmse``, ``map_rmse``, ``map_median`` [m], ``map_landmarks``,
``map_spurious``, ``map_duplicated``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from graphslam.core.errors import UnknownNameError
from graphslam.plots.save import save_figure
from graphslam_studies.association_trial import LOCAL, SINGLE, TrialConfig, run_trial
from graphslam_studies.evaluate.tables import consistency_of
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.plots.association import plot_runs

WORLDS = {name: TrialConfig(name) for name in ("clutter", "pairs", "rows", "hard")}
_FEW = ("known", "ekf-nn", "ekf-jcbb", "ekf-jcbb-smoothed", "rbpf-40", "rbpf1-40", "rbpf-paper")
_SMALL = (("lap_length", 160.0), ("route_waves", 3))
QUICK = {
    "rows-quick": TrialConfig("rows", (*_SMALL, ("landmarks", 8)), 30.0, _FEW),
    "hard-quick": TrialConfig("hard", (*_SMALL, ("landmarks", 16)), 30.0, _FEW),
}

SUMMARY = (
    *("wrong_share", "used_share", "local_spurious", "local_duplicated", "local_missed", "local_pair_precision"),
    *("local_pair_recall", "wrong_merge_share", "missed_merge_share", "pair_precision", "pair_recall", "end_error"),
    *("pose_rmse", "map_rmse", "map_spurious", "map_duplicated", "diverged", "failed"),
)
COMPARED = ("wrong_share", "used_share", "local_pose_nees", "wrong_merge_share", "missed_merge_share", "map_rmse")
PAIRS = (
    # particles against the EKFs
    *(("rbpf-40", "ekf-nn"), ("rbpf-100", "ekf-nn"), ("rbpf-100", "ekf-jcbb-smoothed")),
    *(("rbpf1-40", "ekf-nn"), ("rbpf1-100", "ekf-nn"), ("rbpf1-400", "ekf-nn")),
    *(("rbpf1-100", "ekf-jcbb-smoothed"), ("rbpf1-400", "ekf-jcbb-smoothed"), ("rbpf-paper", "ekf-jcbb")),
    # proposal and number of particles; moment matching
    *(("rbpf1-100", "rbpf-100"), ("rbpf-100", "rbpf-40"), ("rbpf1-400", "rbpf1-100"), ("rbpf-paper", "rbpf-40")),
    # EKFs among themselves
    *(("ekf-jcbb", "ekf-nn"), ("ekf-jcbb-smoothed", "ekf-jcbb"), ("ekf-slam-jcbb", "ekf-slam-nn")),
    ("ekf-slam-jcbb", "ekf-jcbb-smoothed"),
)
DRAWN = {
    "wrong_share": "wrong associations inside submaps",
    "used_share": "true observations rightly used",
    "missed_merge_share": "merges missed between submaps",
    "map_rmse": "map RMSE [m]",
}


class AssociationAmbiguity:
    """See the module."""

    name = "association-ambiguity"
    description = "unknown association in clutter, pairs, rows: EKF (NN, JCBB) against RBPF on errors, divergence, NEES"

    def worlds(self, quick: bool) -> tuple[str, ...]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        return tuple(QUICK if quick else WORLDS)

    def default_trials(self, quick: bool) -> int:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        return 3 if quick else 20

    def trial(self, world: str, quick: bool) -> Callable[[int], Iterable[Measurement]]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        known = {**WORLDS, **QUICK}
        if world not in known:
            raise UnknownNameError("world of association-ambiguity", world, known)
        return partial(run_trial, known[world])

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """Means, medians, 1.96 standard errors (``spread``), ``local_nees``, ``paired`` comparisons, ``seconds``."""
        runs = table[table["submap"] == -1]
        groups = runs[runs["quantity"].isin(SUMMARY)].groupby(["world", "algorithm", "quantity"], sort=False)["value"]
        out = {"summary": _wide(groups.mean()), "medians": _wide(groups.median())}
        out["spread"] = _wide(1.96 * groups.std() / np.sqrt(groups.count()))
        out["local_nees"] = local_nees(table)
        out["paired"] = paired(table)
        if not timings.empty:
            seconds = timings.groupby(["world", "algorithm", "quantity"], sort=False)["value"].mean()
            out["seconds"] = _wide(seconds, tuple(timings["quantity"].unique()))
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """One plot per quantity, with one panel per world: every run of every algorithm."""
        runs = table[table["submap"] == -1]
        made = []
        for quantity, label in DRAWN.items():
            some = runs[runs["quantity"] == quantity]
            if not some.empty:
                rank = some["algorithm"].map({name: k for k, name in enumerate((*LOCAL, *SINGLE))})
                some = some.iloc[np.argsort(rank.to_numpy(), kind="stable")]
                made.append(save_figure(plot_runs(some, label=label), folder / f"{quantity}.png"))
        return made


def _wide(values: pd.Series, order: tuple[str, ...] = SUMMARY) -> pd.DataFrame:
    wide = values.unstack("quantity")
    return wide[[q for q in order if q in wide]].reset_index()


def local_nees(table: pd.DataFrame) -> pd.DataFrame:
    """Consistency of the end poses of local maps; each submap is a unit, because submaps use different data."""
    rows = []
    some = table[table["quantity"] == "local_pose_nees"]
    for (world, algorithm), part in some.groupby(["world", "algorithm"], sort=False):
        _, c = consistency_of(
            part, str(algorithm), "local_pose_nees", dof=3, gauge="submap's first base fixed", unit="value"
        )
        low, high = c.bounds
        known = c.nees[np.isfinite(c.nees)]
        rows.append(
            {
                "world": world,
                "algorithm": algorithm,
                "submaps": c.count,
                "nees_over_n": c.mean_normalised,
                "low": low,
                "high": high,
                "verdict": c.verdict,
                "median_over_n": float(np.median(known) / 3.0),
                "ci_mean": float(np.mean(c.index[np.isfinite(c.nees)])),
                "inside": c.coverage,
                "confidence": c.confidence,
            }
        )
    return pd.DataFrame(rows)


def paired(table: pd.DataFrame) -> pd.DataFrame:
    """Pairs of algorithms on the same runs.

    ``difference``: mean over the runs of algorithm minus reference; ``half_width``: 1.96 standard errors of it;
    ``ratio``: ratio of the geometric means, with 95 % interval ``ratio_low … ratio_high``, over the runs where both are
    positive (``ratio_runs``). ``local_pose_nees`` of a run is the median over its submaps.
    """
    per_run = table[table["quantity"].isin(COMPARED)]
    per_run = per_run.groupby(["world", "run", "algorithm", "quantity"], sort=False)["value"].median()
    rows = []
    for (world, quantity), part in per_run.groupby(["world", "quantity"], sort=False):
        wide = part.unstack("algorithm").reset_index(drop=True)
        for algorithm, reference in PAIRS:
            if algorithm not in wide or reference not in wide:
                continue
            pair = wide[[algorithm, reference]].dropna().to_numpy(dtype=np.float64)
            if len(pair) >= 2:
                figures = _compare(pair)
                rows.append(
                    {"world": world, "quantity": quantity, "algorithm": algorithm, "against": reference, **figures}
                )
    return pd.DataFrame(rows)


def _compare(pair: np.ndarray) -> dict[str, float]:
    d = pair[:, 0] - pair[:, 1]
    out = {
        "runs": len(d),
        "difference": float(d.mean()),
        "half_width": float(1.96 * d.std(ddof=1) / np.sqrt(len(d))),
        "lower_in": int(np.sum(d < 0)),
        "equal_in": int(np.sum(d == 0)),
    }
    positive = np.all(pair > 0, axis=1)
    log = np.log(pair[positive, 0] / pair[positive, 1])
    out["ratio_runs"] = len(log)
    if len(log) >= 2:
        centre, half = float(log.mean()), float(1.96 * log.std(ddof=1) / np.sqrt(len(log)))
        out |= {
            "ratio": float(np.exp(centre)),
            "ratio_low": float(np.exp(centre - half)),
            "ratio_high": float(np.exp(centre + half)),
        }
    return out


STUDY = AssociationAmbiguity()
