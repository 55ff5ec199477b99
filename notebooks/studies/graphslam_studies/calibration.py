"""The study ``calibration``: noise and systematic errors estimated from a log, and the maps made with them.

Worlds: ``drawn``: random robots whose logs state a quarter of their true σ (``drawn-correlated``: errors correlated
over seconds; ``planted``: one constant error at a time, and none); ``plaza1`` with a yaw-rate bias of 0.31 deg/s added;
the robots of MRCLAM 7, each without its preset; and recorded sets with scans, with a random yaw bias, scale and
odometry noise added in each run. The recorded sets must be available (``GRAPHSLAM_DATA``).

Quantities
----------
``…_ratio``: estimated over true σ; ``…_error``: estimated minus true constant (rad/s, a factor, s, m, rad); ``path``,
``landmarks`` [m]; ``nees_poses``, ``nees_landmarks`` per degree of freedom; ``join_chi2_per_dof``.
Of scans: ``relations``: error of relative poses of random pairs [m]; ``…_input``: that of the input odometry;
``input_reported``: the verdict reports that the input is better; ``worse_unreported``: the path error is 10 % larger
than that of the input, without such a report. Planted errors: ``within``: true value within 3σ of the estimate;
``corrected``; ``strength``: error/σ; ``false``: number of other constants that were corrected.
Algorithms: ``stated``, ``calibrated``, ``oracle``, ``preset``; of scans as in
:func:`graphslam_studies.calibration_scanned.scanned`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from graphslam_studies.calibration_scanned import Added
from graphslam_studies.calibration_trial import PLANTED, CalibrationTrialConfig, run_calibration_trial
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs, whole

BIAS = float(np.deg2rad(0.31))
WORLDS = {
    "drawn": CalibrationTrialConfig(),
    "drawn-correlated": CalibrationTrialConfig(correlated=True, seconds=300.0),
    "planted": CalibrationTrialConfig(planted=tuple(PLANTED)),
    "plaza1": CalibrationTrialConfig(source="plaza1", added=Added(bias=BIAS), presets="plaza1.rbpf-ekf"),
}
WORLDS |= {
    f"mrclam-{k}": CalibrationTrialConfig(source=f"mrclam-dataset7/robot{k}", presets="mrclam-dataset7.rbpf-ekf")
    for k in range(1, 6)
}
WORLDS |= {
    name: CalibrationTrialConfig(
        source=name, added=None, first=600.0, presets=f"{name}.segslam", frontend="segslam", motions=motions
    )
    for names, motions in (
        (("radish-intel", "radish-fr079", "radish-mit-csail"), ("preset", "calibrated")),
        (("lidar3d-hku1", "lidar3d-hku-mb", "lidar3d-balm-hall"), ("recorded", "calibrated")),
    )
    for name in names
}
"""Only the first ten minutes of the logs with scans are used."""
QUICK_WORLDS = {
    "drawn-quick": CalibrationTrialConfig(seconds=40.0),
    "planted-quick": CalibrationTrialConfig(seconds=40.0, planted=("yaw rate 0.3 deg/s",)),
}
PLANTED_FIGURES = ("within", "corrected", "strength", "false", "false_clock", "normalised_error")
MAPS = (
    *("path", "landmarks", "nees_poses", "nees_landmarks", "join_chi2_per_dof"),
    *("relations", "relations_input", "path_input", "input_reported", "worse_unreported", "calibration_refused"),
)


class CalibrationStudy(WorldsStudy[CalibrationTrialConfig]):
    """See the module."""

    run_one = staticmethod(run_calibration_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``maps`` for each noise model, ``found``: ratios and errors of estimates, ``planted`` errors, ``cpu`` [s]."""
        out = {"maps": maps_table(table), "found": found_table(table), "planted": planted_table(table)}
        out = {name: rows for name, rows in out.items() if not rows.empty}
        if not timings.empty:
            rows = timings[timings["quantity"] == "cpu_seconds"].groupby("world")["value"].agg(["mean", "max"])
            out["cpu"] = rows.reset_index()
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """NEES and errors of all runs."""
        return draw_runs(table, {"nees_poses": "NEES/dof of poses", "path": "path error [m]"}, folder)


def maps_table(table: pd.DataFrame) -> pd.DataFrame:
    """Means over the runs, one row per world and noise model."""
    rows = table[table["quantity"].isin(MAPS) & (table["submap"] == -1) & table["value"].notna()]
    if rows.empty:
        return pd.DataFrame(columns=["world", "algorithm", *MAPS])
    wide = rows.pivot_table(index=["world", "algorithm"], columns="quantity", values="value", sort=False)
    return wide.reindex(columns=[q for q in MAPS if q in wide]).reset_index()


def found_table(table: pd.DataFrame) -> pd.DataFrame:
    """Median, minimum, maximum and RMS over the runs of each ratio and error."""
    out = []
    ends = ("_ratio", "_error", "_reported", "_applied", "refused")
    names = [q for q in table["quantity"].unique() if q.endswith(ends) and q not in MAPS]
    for (world, algorithm), rows in table.groupby(["world", "algorithm"], sort=False):
        for name in names:
            v = whole(rows, name)["value"].to_numpy()
            if len(v):
                row = {"world": world, "algorithm": algorithm, "quantity": name, "runs": len(v)}
                row |= {"median": float(np.median(v)), "least": float(v.min()), "greatest": float(v.max())}
                out.append(row | {"rms": float(np.sqrt(np.mean(v**2)))})
    return pd.DataFrame(out)


def planted_table(table: pd.DataFrame) -> pd.DataFrame:
    """One row per planted error: means over the runs, e.g. of the strength (error / σ); RMS of the normalised error."""
    out = []
    rows = table[table["quantity"].isin(["false"])]
    for (world, name), _ in rows.groupby(["world", "algorithm"], sort=False):
        runs = table[(table["world"] == world) & (table["algorithm"] == name)]
        v = {q: whole(runs, q)["value"].to_numpy() for q in PLANTED_FIGURES}
        row: dict[str, object] = {"world": world, "error": name, "runs": len(v["false"])}
        row |= {q: float(np.mean(x)) if len(x) else np.nan for q, x in v.items() if q != "normalised_error"}
        z = v["normalised_error"]
        out.append(row | {"normalised_error": float(np.sqrt(np.mean(z**2))) if len(z) else np.nan})
    return pd.DataFrame(out)


STUDY = CalibrationStudy(
    "calibration",
    "noise, biases and scales estimated from the log: random robots, and recorded logs without their presets",
    WORLDS,
    QUICK_WORLDS,
    trials=10,
)
