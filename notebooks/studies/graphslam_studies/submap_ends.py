"""The study ``submap-ends``: the decision strategy of Combined SLAM (section 6.1) against fixed cuts.

A car drives a closed loop among features with known identities. Route, features, and noise of controls and sensor are
random in every run (:func:`drawn_field`). All strategies get the same log. Algorithms are named ``maps/strategy``.

Maps: ``paper``, moments of 40 particles, joined by the binary tree of the paper; ``default``, smoothed, joined by the
tree along arcs. ``…+polish``: the least-squares optimum of the same maps.

Strategies: ``fixed-N``: N scans. ``features-N``: criterion (iii) alone, N features in the standard particle.
``rule-N``: (i) a time without features, (ii) diversity lost, (iii) N features, with the values of the preset
``paper.rbpf-ekf``. ``rule-N-early``: (ii) at 10 ancestors instead of one. ``rule-N-no-time``,
``rule-N-no-diversity``: without (i), without (ii). ``own``: the default of the front end.

Quantities
----------
``pose_nees``, ``feature_nees``, ``feature_joint_nees``, ``feature_rms`` … as in ``combined-slam``, of the whole map;
of local map k ``local_joint_nees``, ``local_joint_dof``, ``local_features``; ``submaps``; ``mean_features``, per
submap; ``ended_features``, ``ended_diversity``, ``ended_no-features``: submaps that a criterion ended; ``failed``.
Timings: ``seconds_total``, CPU of local maps and joining.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pandas as pd

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.config import preset
from graphslam.app.run.front_ends import make_front_end
from graphslam.core.config import merge_options
from graphslam.core.errors import GraphSlamError
from graphslam.core.gaussian import chi2_quantile
from graphslam.core.random import SeedTree
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_tree
from graphslam.sim.landmark_config import LandmarkFieldConfig
from graphslam.sim.landmark_field import simulate_landmark_field
from graphslam_studies.evaluate.intervals import grouped_mean_interval
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs, whole
from graphslam_studies.scoring import Judge

PAPER = preset("paper.rbpf-ekf")["frontend"]
MAPS: dict[str, dict[str, Any]] = {"paper": {k: v for k, v in PAPER.items() if k != "stopping"}, "default": {}}
OFF = {"time_max": 1e9, "max_distance": 1e9, "max_scans": 10**9}
RULE = OFF | {k: v for k, v in PAPER["stopping"].items() if k != "max_distance"}
STRATEGIES: dict[str, dict[str, Any]] = {
    **{f"fixed-{n}": {"scans": n} for n in (30, 60, 120, 240)},
    **{f"features-{n}": OFF | {"num_features": n} for n in (6, 15, 30, 60)},
    **{f"rule-{n}": RULE | {"num_features": n} for n in (15, 30, 60)},
    "rule-30-early": RULE | {"num_features": 30, "min_ancestors": 10},
    "rule-30-no-time": RULE | {"num_features": 30, "time_max": 1e9},
    "rule-30-no-diversity": RULE | {"num_features": 30, "min_ancestors": 0},
    "own": {},
}
CASES = (
    *(f"paper/{s}" for s in STRATEGIES if s != "own"),
    *(f"default/{s}" for s in ("fixed-60", "fixed-240", "rule-15", "rule-30", "rule-60", "own")),
)
PAIRS = (
    *((f"paper/rule-{n}", f"paper/fixed-{f}") for n in (15, 30, 60) for f in (30, 60, 120, 240)),
    *((f"paper/rule-{n}", f"paper/features-{n}") for n in (15, 30, 60)),
    *(("paper/rule-30", f"paper/rule-30-no-{part}") for part in ("time", "diversity")),
    *(("paper/rule-30-early", f"paper/{s}") for s in ("rule-30", "fixed-30", "fixed-60", "fixed-120")),
    *((f"paper/features-{n}", "paper/features-30") for n in (6, 15, 60)),
    ("paper/rule-30", "default/own"),
    *(("default/rule-30", f"default/{s}") for s in ("fixed-60", "fixed-240", "rule-15", "rule-60", "own")),
)
COMPARED = ("feature_nees", "feature_rms", "pose_nees", "cpu")


@dataclass(frozen=True)
class EndsConfig:
    """Limits of the drawn length of a lap [m], and the cases."""

    lap: tuple[float, float] = (600.0, 1200.0)
    cases: tuple[str, ...] = CASES


def drawn_field(config: EndsConfig, seed: int) -> LandmarkFieldConfig:
    """A random route of 1.1 to 1.5 laps, density of features, and noise of controls and sensor."""
    rng = SeedTree(seed).child("field").generator()

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    lap = between(*config.lap)
    return LandmarkFieldConfig(
        lap_length=lap,
        laps=between(1.1, 1.5),
        route_waves=int(rng.integers(3, 9)),
        route_amplitude=between(0.03, 0.08),
        landmarks=round(lap * between(0.08, 0.4)),
        sigma_range=between(0.1, 0.5),
        sigma_bearing=np.radians(between(1.0, 5.0)),
        sigma_speed=between(0.15, 0.6),
        sigma_steering=np.radians(between(1.5, 6.0)),
    )


def run_trial(config: EndsConfig, seed: int) -> list[Measurement]:
    """All metrics of one run (see the module)."""
    with one_blas_thread():
        return list(_trial(config, seed))


def _trial(config: EndsConfig, seed: int) -> Iterator[Measurement]:
    field = drawn_field(config, seed)
    log = simulate_landmark_field(field, seed)
    assert log.truth is not None
    for case in config.cases:
        maps, strategy = case.split("/")
        options = {"association": "known", "stopping": STRATEGIES[strategy]}
        front_end = make_front_end("rbpf-ekf", merge_options(MAPS[maps], options))
        begin = process_time()
        try:
            submaps = list(front_end.submaps(log, seed=SeedTree(seed).child("frontend")))
            joined = join_tree(submaps, classical=maps == "paper")
            spent = process_time() - begin
            best = optimise_from_join(submaps, joined)
            judge = Judge(log.truth, np.array([s.interval[1] for s in submaps]), field.distance)
            rows = [*judge.estimate(case, joined), *judge.estimate(f"{case}+polish", best)]
            rows += judge.local(case, submaps)
        except GraphSlamError:  # a collapsed particle set has a singular covariance
            yield Measurement(case, "failed", 1.0)
            continue
        yield from rows
        yield Measurement(case, "failed", 0.0)
        yield Measurement(case, "submaps", len(submaps))
        yield Measurement(
            case, "mean_features", float(np.mean([r.value for r in rows if r.quantity == "local_features"]))
        )
        for reason in ("features", "diversity", "no-features"):
            yield Measurement(case, f"ended_{reason}", sum((s.report or {}).get("ended") == reason for s in submaps))
        yield Measurement(case, "seconds_total", spent, timing=True)


def size_table(table: pd.DataFrame) -> pd.DataFrame:
    """Submaps of every case: number, features by pose dimensions, what ended them; their joint NEES by dof."""
    out = []
    for (world, case), own in table.groupby(["world", "algorithm"], sort=False):
        if not (own["quantity"] == "failed").any():
            continue
        sums = own.groupby("quantity")["value"].sum()
        means = own[own["submap"] < 0].groupby("quantity")["value"].mean()
        row = {"world": world, "algorithm": case, "runs": int((own["quantity"] == "failed").sum())}
        row |= {"failed": int(sums["failed"]), "submaps": means.get("submaps", np.nan)}
        row["features/pose dimension"] = means.get("mean_features", np.nan) / 3.0
        row |= {q: means.get(q, np.nan) for q in ("ended_features", "ended_diversity", "ended_no-features")}
        row["local NEES/n"] = sums.get("local_joint_nees", np.nan) / sums.get("local_joint_dof", np.nan)
        out.append(row)
    return pd.DataFrame(out)


def map_table(table: pd.DataFrame) -> pd.DataFrame:
    """Whole maps: CI of end pose and features (mean, median over runs), joint feature NEES by dof, RMS."""
    out = []
    for (world, case), own in table.groupby(["world", "algorithm"], sort=False):
        wide = own[own["submap"] < 0].pivot(index="run", columns="quantity", values="value")
        if "feature_nees" not in wide:
            continue
        wide = wide.dropna(subset=["feature_nees"])
        row: dict[str, Any] = {"world": world, "algorithm": case, "runs": len(wide)}
        for what, dof in (("pose", 3), ("feature", 2)):
            ci = wide[f"{what}_nees"] / chi2_quantile(0.95, dof)
            row |= {f"{what} CI mean": ci.mean(), f"{what} CI median": ci.median()}
        row["joint NEES/n"] = wide["feature_joint_nees"].sum() / wide["feature_joint_dof"].sum()
        row |= {"feature RMS m": wide["feature_rms"].mean(), "feature RMS median": wide["feature_rms"].median()}
        out.append(row)
    return pd.DataFrame(out)


def paired_table(table: pd.DataFrame, timings: pd.DataFrame) -> pd.DataFrame:
    """Geometric mean of the ratio a/b over runs that both finished, with bootstrap bounds over the runs."""
    cpu = timings[timings["quantity"] == "seconds_total"].assign(quantity="cpu")
    rows = pd.concat([table, cpu]) if len(cpu) else table
    pairs = [*PAIRS, *((f"{a}+polish", f"{b}+polish") for a, b in PAIRS)]
    rng = SeedTree(0).child("report", "submap-ends").generator()
    out = []
    for world in dict.fromkeys(table["world"]):
        for quantity in COMPARED:
            of = whole(rows[rows["world"] == world], quantity)
            wide = of.pivot(index="run", columns="algorithm", values="value")
            for a, b in pairs:
                if not {a, b} <= set(wide.columns) or len(both := wide[[a, b]].dropna()) < 2:
                    continue
                logs = np.log(both[a].to_numpy() / both[b].to_numpy())
                mean, low, high = np.exp(grouped_mean_interval(logs, both.index, rng))
                row = {"world": world, "quantity": quantity, "a": a, "b": b, "a/b": mean, "low": low, "high": high}
                out.append(row | {"a smaller in": int(np.sum(logs < 0)), "runs": len(logs)})
    return pd.DataFrame(out)


class SubmapEnds(WorldsStudy[EndsConfig]):
    """See the module."""

    run_one = staticmethod(run_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``submaps``, ``maps``, ``pairs``: run by run; ``seconds``: mean CPU."""
        own = timings[timings["quantity"] == "seconds_total"]
        seconds = own.groupby(["world", "algorithm"], sort=False)["value"].mean().reset_index() if len(own) else own
        return {
            "submaps": size_table(table),
            "maps": map_table(table),
            "pairs": paired_table(table, timings),
            "seconds": seconds,
        }

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Feature errors of all runs."""
        return draw_runs(table[table["algorithm"].str.endswith("+polish")], {"feature_rms": "feature RMS [m]"}, folder)


STUDY = SubmapEnds(
    "submap-ends",
    "when a submap shall end: the criteria of Combined SLAM 6.1 against fixed cuts, in random worlds",
    {"random": EndsConfig()},
    {"quick": EndsConfig((150.0, 200.0), ("paper/fixed-60", "paper/features-15", "paper/rule-15", "default/own"))},
)
