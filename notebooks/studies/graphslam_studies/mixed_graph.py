"""The study ``mixed``: one graph with landmark submaps, dense submaps, matches, GPS and IMU, by every method.

Every run has a random mixed world (building, trees, route, biases, all noise levels; :mod:`graphslam.sim.mixed`). Both
front ends map it, ``rbpf-ekf`` where trees are visible and ``segslam`` elsewhere. The graph is solved four times: with
GPS and IMU, with one of them, and with neither. Identities of the trees are known, so landmarks are scored too.

Algorithms
----------
``<method>+gps+imu``, ``<method>+gps``, ``<method>+imu``, ``<method>``: the method, and the sensors besides the submaps.

Quantities
----------
``nees_before``, ``nees_after``: joint NEES of all submap end poses and all trees, first base fixed, before and after
relinearisation; ``dof`` its dimension. ``objective_before``, ``objective_after``; ``rmse_poses``,
``rmse_landmarks`` [m] after. Of ``batch`` besides: ``nees_poses`` with ``dof_poses``, ``nees_landmarks`` with
``dof_landmarks``, and ``chi2_<class>`` with ``dof_<class>`` of ``submaps`` (of both kinds, with matches), ``gps``,
``imu``.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import graphslam as gs
from graphslam.app.compare import DEFAULT_METHODS, compare_methods, map_nees
from graphslam.app.machine import one_blas_thread
from graphslam.app.submap_sources import poses_only
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.core.map_truth import MapTruth
from graphslam.graph.factor_graph import FactorGraph
from graphslam.join.graph_join import GraphEstimate
from graphslam.join.graph_problem import JoinProblem
from graphslam.join.registry import join_by_method
from graphslam.sim.mixed import MixedConfig, mixed_preset, simulate_mixed
from graphslam_studies.evaluate.intervals import mean_interval
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs
from graphslam_studies.segslam_report import values

SENSORS = ("+gps+imu", "+gps", "+imu", "")
"""Sensors besides the submaps."""
WANTED = (0.9, 1.12)
"""Target interval of NEES/n of the optimum over all runs."""
OPTIONS: dict[str, Any] = {
    "frontend": {"rbpf-ekf": {"association": "known"}},
    "imu": {"use": "auto"},
    "map": {"fuse": False},
}


def run_mixed_trial(config: MixedConfig, seed: int) -> list[Measurement]:
    """All metrics of one run."""
    with one_blas_thread():
        return list(_figures(config, seed))


def _figures(config: MixedConfig, seed: int) -> Iterator[Measurement]:
    log = simulate_mixed(config, seed)
    run = gs.run(log, frontend=["segslam", "rbpf-ekf"], config=OPTIONS, seed=seed, progress=False)
    assert run.graph is not None
    assert run.truth is not None
    for sensors in SENSORS:
        problem = JoinProblem.of_graph(with_sensors(run.graph, sensors))
        table = compare_methods(problem, truth=run.truth, memory=False)
        for row in table.to_dict("records"):
            name = f"{row['method']}{sensors}"
            found = {
                "nees_before": row["nees"] if row["nees_unpolished"] is None else row["nees_unpolished"],
                "nees_after": row["nees"],
                "dof": row["nees_dof"],
                "objective_before": row["objective"],
                "objective_after": row["objective_polished"],
                "rmse_poses": row["rmse_poses"],
                "rmse_landmarks": row["rmse_landmarks"],
            }
            yield from (Measurement(name, quantity, float(value)) for quantity, value in found.items())
            yield Measurement(name, "seconds", float(row["seconds"]), timing=True)
        yield from _parts(f"batch{sensors}", problem, run.truth)


def with_sensors(graph: FactorGraph, sensors: str) -> FactorGraph:
    """A copy of a graph without fixes or IMU, unless ``sensors`` contains their name."""
    out = copy.deepcopy(graph)
    unwanted = tuple(name for name in ("gps", "imu") if f"+{name}" not in sensors)
    for fid in [k for k, r in out.records.items() if r.group.startswith(unwanted or ("-",))]:
        if fid in out.records:  # biases are removed with the last factor that uses them
            out.remove(fid, reason="the graph is solved without this sensor")
    return out


def _parts(name: str, problem: JoinProblem, truth: MapTruth) -> Iterator[Measurement]:
    """NEES of poses and of landmarks separately, and χ² of every class of factors, at the optimum."""
    best: GraphEstimate = join_by_method(problem, "batch")  # type: ignore[assignment]
    no_poses = replace(truth, keys=truth.keys[:0], exit_poses=truth.exit_poses[:0])
    for part, one in (("poses", poses_only(truth)), ("landmarks", no_poses)):
        d2, dof = map_nees(best, problem.keys, one)  # type: ignore[arg-type]
        yield Measurement(name, f"nees_{part}", d2)
        yield Measurement(name, f"dof_{part}", float(dof))
    score = problem.graph.objective(best.values)
    sums: dict[str, list[float]] = {}
    for group in problem.factor_counts():
        # both kinds of submaps measure the nodes, so only the sum of their degrees of freedom is known
        whole = sums.setdefault(group.split("-")[0] if group.startswith(("gps", "imu")) else "submaps", [0.0, 0.0])
        whole[0] += score[group].chi2
        whole[1] += score[group].dof
    for group, (total, rows) in sums.items():
        yield Measurement(name, f"chi2_{group}", total)
        yield Measurement(name, f"dof_{group}", rows)


class MixedStudy(WorldsStudy[MixedConfig]):
    """See the module."""

    run_one = staticmethod(run_mixed_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``consistency`` of every method, ``parts`` and ``factors`` of the optimum, ``verdict``."""
        found = consistency_table(table)
        return {
            "consistency": found,
            "parts": pd.DataFrame([_ratio(table, *case, "nees_", p) for case in _cases(table, "batch") for p in PARTS]),
            "factors": factor_table(table),
            "verdict": pd.DataFrame({"verdict": sentences(found)}),
        }

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """NEES/n of all runs before and after relinearisation."""
        drawn = []
        dof = table[table["quantity"] == "dof"].set_index(["world", "run", "algorithm"])["value"]
        for when in ("before", "after"):
            rows = table[table["quantity"] == f"nees_{when}"].set_index(["world", "run", "algorithm"])
            drawn.append(rows.assign(value=rows["value"] / dof).reset_index())
        labels = {f"nees_{when}": f"NEES/n {when} relinearisation" for when in ("before", "after")}
        return draw_runs(pd.concat(drawn), labels, folder)


PARTS = ("poses", "landmarks")


def _cases(table: pd.DataFrame, *methods: str) -> list[tuple[str, str]]:
    """Pairs of world and algorithm, for some methods."""
    names = [f"{m}{s}" for s in SENSORS for m in methods]
    return [(w, a) for w in dict.fromkeys(table["world"].astype(str)) for a in names]


def _ratio(table: pd.DataFrame, world: str, algorithm: str, prefix: str, part: str) -> dict[str, Any]:
    """Sum of a χ² over all runs per degree of freedom, with two-sided 95 % bounds."""
    x, n = (values(table, world, algorithm, f"{p}{part}") for p in (prefix, "dof_"))
    total = float(n.sum())
    row: dict[str, Any] = {"world": world, "graph": algorithm, "part": part, "runs": len(x), "n": total}
    if total > 0:
        low, high = chi2_mean_bounds(total, 1)
        row |= {"value": float(x.sum()) / total, "low": low / total, "high": high / total}
    return row


def consistency_table(table: pd.DataFrame) -> pd.DataFrame:
    """NEES/n of the joint map of every method before and after relinearisation, over all runs.

    ``low`` and ``high``: two-sided 95 % bounds of a consistent estimator, pooled over all runs. ``±``: half of
    Student's 95 % interval of the mean of NEES/n over the runs. ``gap``: largest relative change of the objective.
    """
    out = []
    for world, algorithm in _cases(table, *DEFAULT_METHODS):
        before, after, n, a, b, rp, rl = (
            values(table, world, algorithm, q)
            for q in ("nees_before", "nees_after", "dof", "objective_before", "objective_after", *RMSE)
        )
        if not len(n):
            continue
        low, high = chi2_mean_bounds(float(n.sum()), 1)
        row = {"world": world, "algorithm": algorithm, "runs": len(n), "n": float(n.mean())}
        for when, x in (("before", before), ("after", after)):
            _, left, right = mean_interval(x / n)
            row |= {f"NEES/n {when}": float(x.sum() / n.sum()), f"± {when}": 0.5 * (right - left)}
        row |= {"low": low / n.sum(), "high": high / n.sum(), "gap": float(np.max(np.abs(a / b - 1.0)))}
        out.append(row | {"rmse_poses": float(rp.mean()), "rmse_landmarks": float(rl.mean())})
    return pd.DataFrame(out)


RMSE = ("rmse_poses", "rmse_landmarks")


def factor_table(table: pd.DataFrame) -> pd.DataFrame:
    """χ² per degree of freedom of every class of factors at the optimum, over all runs."""
    groups = [q.removeprefix("chi2_") for q in dict.fromkeys(table["quantity"]) if q.startswith("chi2_")]
    rows = [_ratio(table, *case, "chi2_", g) for case in _cases(table, "batch") for g in groups]
    return pd.DataFrame([r for r in rows if r["n"] > 0])


def sentences(found: pd.DataFrame) -> list[str]:
    """One sentence per graph: consistency of the map at the optimum, and NEES/n before relinearisation."""
    out = []
    for (world, sensors), rows in found.assign(s=found["algorithm"].str.extract(r"(\+.*|)$")[0]).groupby(
        ["world", "s"], sort=False
    ):
        one = rows.set_index("algorithm")
        best = one.loc[f"batch{sensors}"]
        value = best["NEES/n after"]
        word = "conservative" if value < WANTED[0] else "overconfident" if value > WANTED[1] else "consistent"
        others = ", ".join(
            f"{m} {one.loc[m + sensors, 'NEES/n before']:.2f}" for m in DEFAULT_METHODS if m + sensors in one.index
        )
        out.append(
            f"{world}, submaps{sensors}: the optimum is {word}, NEES/n {value:.3f} over {best['runs']} runs "
            f"(wanted {WANTED[0]:g} to {WANTED[1]:g}); before relinearisation {others}"
        )
    return out


STUDY = MixedStudy(
    "mixed",
    "one graph of landmark submaps, dense submaps, GPS and IMU: consistency of each method, with and without a sensor",
    {"full": mixed_preset("full")},
    {"quick": mixed_preset("quick")},
    trials=20,
)
