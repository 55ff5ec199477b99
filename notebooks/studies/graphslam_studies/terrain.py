"""The study ``terrain``: detection distance and false alarms for obstacles, edges and holes.

Every run has a random street per kind of target, and drives towards it (world ``panning``), or past it with the laser
fixed (``fixed``), or waits 30 s at 9 m before a curb and then drives (``standing``). Five maps use the same lines:

* ``multigrid``: one map per range band, learnt weights; the finest map with a known cell is used;
* ``single-learnt``: one grid of 0.2 m, the same learnt weights, all ranges added;
* ``single-fine``: one grid of 0.1 m, as fine as the finest band, with the weights learnt for 0.2 m;
* ``single-octomap``: one grid of 0.2 m, log-odds +0.85 for a hit (step or depth ≥ 6 cm, or overhang), −0.4 for a
  miss, hazard above 0;
* ``single-equal``: the same with ±0.4.

Quantities
----------
``seen_<target>``: 1 if any cell of the target (± 1 cell) in the 1 m corridor is classified as a hazard; for harmless
targets, if any cell there is. ``width_<target>``: share of the corridor width with such a cell. ``blocked_<target>``: 1
if no straight gap as wide as the vehicle is left in the lane. ``submap`` is the distance of the sensor [cm].
``false_<ring>``: share of free known cells ahead classified as a hazard; ``false_open_<ring>``: of those farther than
0.5 m from any cell that is not free; ``false_flat``: the same within 7 m on streets without a target.
``coverage``: known share of the free lane 0.8–8 m ahead, within ±60°. ``calibration_n, _p, _h``: cells, sum of P and
hazards by decile of P, each band in its own cells. Timings: ``line_us``, ``times_real_time``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from graphslam.maps.terrain.tables import read_tables
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy
from graphslam_studies.sim.street import StreetRobot
from graphslam_studies.terrain_trial import RINGS, TerrainTrialConfig, run_terrain_trial

WORLDS = {
    "panning": TerrainTrialConfig(start=12.0),
    "fixed": TerrainTrialConfig(laser="fixed", distances=(5.25, 2.25)),
    "standing": TerrainTrialConfig(targets=("curb-10", "curb-15"), start=9.0, robot=StreetRobot(stand=30.0)),
}
QUICK_WORLDS = {
    "quick": TerrainTrialConfig(targets=("nothing", "curb-10", "hole-1.0"), start=7.0, distances=(5.25, 2.25)),
    "quick-fixed": TerrainTrialConfig(laser="fixed", targets=("curb-15",), distances=(2.25,)),
}


class TerrainStudy(WorldsStudy[TerrainTrialConfig]):
    """Detection, false alarms, coverage and calibration of terrain maps."""

    run_one: Callable[[TerrainTrialConfig, int], Iterable[Measurement]] = staticmethod(run_terrain_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        out: dict[str, pd.DataFrame] = {}
        for world, rows in table.groupby("world", sort=False):
            for what, title in (
                ("seen", "share of drives in which the target is seen"),
                ("width", "share of its width"),
                ("blocked", "share of drives in which the lane is closed"),
            ):
                out[f"{world}: {title}, by distance [m]"] = by_distance(rows, what)
            alarms = whole_runs(
                rows, [f"{k}_{r}" for r in RINGS for k in ("false", "false_open")] + ["false_flat", "coverage"]
            )
            if len(alarms):
                out[f"{world}: false alarms by ring [m], coverage of 0.8–8 m ahead"] = alarms
            calibrated = calibration(rows)
            if len(calibrated):
                out[f"{world}: probabilities against ground truth"] = calibrated
        out["what the figures hold for"] = conditions(
            {**self.full, **self.quick}, [str(w) for w in table["world"].unique()]
        )
        if len(timings):
            cost = timings.groupby(["world", "quantity"])["value"].median().reset_index()
            out["cost"] = cost.rename(columns={"value": "median"})
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`; no plots."""
        return []


def by_distance(rows: pd.DataFrame, what: str) -> pd.DataFrame:
    """Mean over runs by target and map, one column per distance."""
    mine = rows[rows["quantity"].str.startswith(f"{what}_")].copy()
    mine["target"] = mine["quantity"].str.removeprefix(f"{what}_")
    mine["distance"] = mine["submap"] / 100.0
    wide = mine.pivot_table(index=["target", "algorithm"], columns="distance", values="value", sort=False)
    counts = mine.groupby(["target", "algorithm"])["run"].nunique()
    wide.columns = [f"{c:g}" for c in wide.columns]
    wide.insert(0, "drives", counts)
    return wide.reset_index()


def whole_runs(rows: pd.DataFrame, quantities: list[str]) -> pd.DataFrame:
    """Mean over runs by map, one column per quantity."""
    mine = rows[rows["quantity"].isin(quantities) & (rows["submap"] == -1)]
    if mine.empty:
        return mine
    wide = mine.pivot_table(index="algorithm", columns="quantity", values="value", sort=False)
    return wide[[q for q in quantities if q in wide]].reset_index()


def calibration(rows: pd.DataFrame) -> pd.DataFrame:
    """Expected calibration error over all cells, and over cells with P in 0.1–0.9."""
    out = []
    mine = rows[rows["quantity"].str.startswith("calibration_")]
    for name, of in mine.groupby("algorithm", sort=False):
        wide = of.pivot_table(index="submap", columns="quantity", values="value", aggfunc="sum").fillna(0.0)
        n, p, h = (wide[f"calibration_{k}"].to_numpy() for k in "nph")
        off = np.abs(p - h)
        middle = (wide.index >= 1) & (wide.index <= 8)
        row = {"algorithm": name, "error 0.1–0.9": off[middle].sum() / max(n[middle].sum(), 1.0)}
        row |= {"error, all cells": off.sum() / max(n.sum(), 1.0), "cells 0.1–0.9": int(n[middle].sum())}
        out.append(row | {f"h {k / 10:g}": hits / many for k, hits, many in zip(wide.index, h, n) if many})
    return pd.DataFrame(out)


def conditions(configs: dict[str, TerrainTrialConfig], worlds: list[str]) -> pd.DataFrame:
    """Threshold, vehicle, sweep and braking of every world."""
    tables = read_tables()
    out = []
    for world in worlds:
        c = configs[world]
        v, s = c.vehicle, c.sensor
        out.append(
            {
                "world": world,
                "threshold": tables.threshold,
                "climbable step [m]": v.climbable_step,
                "steepest [deg]": float(np.rad2deg(v.max_slope)),
                "sweep [s]": s.sweep_time,
                "reaction [s]": v.reaction_time,
                "braking [m/s²]": v.deceleration,
                "braking distance at 1 m/s [m]": v.braking_distance(1.0),
                "holes are seen up to [m]": s.hole_reach(v),
                f"falls of {v.clearance:g} m up to [m]": s.hole_reach(v, v.clearance),
                "speed bound [m/s]": s.speed_bound(v),
                "two beams on 10 cm up to [m]": s.step_reach(0.1),
                "learnt on seeds": ", ".join(str(k) for k in tables.provenance.get("seeds", [])),
            }
        )
    return pd.DataFrame(out)


STUDY = TerrainStudy(
    "terrain",
    "Obstacles, edges and holes seen from afar: a map a range band beside one of a single resolution.",
    WORLDS,
    QUICK_WORLDS,
)
