"""Three sessions of one campus merged in one map: two overlap; the third is connected by GPS only.

``overlap`` and ``far``: error of the start of the second and the third session in the frame of the first, compared
with its covariance in the merged graph. ``untied``: the third session without fixes; an error must name it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from time import process_time
from typing import Any

import numpy as np
from scipy import stats

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.pipeline import run as run_log
from graphslam.app.sessions.merge_dense import MergedSubmaps, merge_dense
from graphslam.core.config import options_dict
from graphslam.core.errors import DataError, SolverError
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.poses import SE3
from graphslam_studies.campus_trial import CampusTrialConfig, Judge, submap_lift
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.sim.campus import simulate_campus

NAMES = ("first", "overlap", "far")
THREE_SIGMA = float(stats.chi2.cdf(9.0, 1))
"""Probability of one scalar within 3 σ; for more dimensions the quantile of this probability is used."""


def run_sessions_trial(config: CampusTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one set of three sessions."""
    with one_blas_thread():
        return list(session_figures(config, seed))


def session_figures(config: CampusTrialConfig, seed: int) -> Iterator[Measurement]:
    """Simulate three sessions, run each, and merge them."""
    begin = process_time()
    logs = [simulate_campus(replace(config.campus, session=k, far=k == 2), seed) for k in range(3)]
    options: dict[str, Any] = {"frontend": options_dict(config.front_end), "backend": options_dict(config.back_end)}
    options |= {"gps": options_dict(config.gps), "refine": {"use": False}}
    runs = [
        run_log(log, frontend="scan-window", solver="batch", seed=seed, config=options, progress=False) for log in logs
    ]
    ran = process_time()
    merged = merge_dense(runs, NAMES)
    yield Measurement("all", "sessions", float(len(merged.sessions)))
    yield Measurement("all", "ate", merged.metric("path_rmse_aligned"))
    starts = [start_of(log, config) for log in logs]
    for k, name in ((1, "overlap"), (2, "far")):
        yield from seam(merged, k, name, SE3.between(starts[0], starts[k]))
    options["gps"] = {**options["gps"], "use": "none"}
    blind = run_log(logs[2], frontend="scan-window", solver="batch", seed=seed, config=options, progress=False)
    try:
        merge_dense([runs[0], blind], (NAMES[0], "blind"))
    except (DataError, SolverError) as error:
        yield Measurement("untied", "refused", float("blind" in str(error)))
    else:
        yield Measurement("untied", "refused", 0.0)
    for kind in ("all", "overlap", "far", "untied"):
        yield Measurement(kind, "failed", 0.0)
    yield Measurement("all", "seconds_runs", ran - begin, timing=True)
    yield Measurement("all", "seconds_merge", process_time() - ran, timing=True)


def start_of(log: SensorLog, config: CampusTrialConfig) -> Array:
    """True first base of a run in the world ``(7,)``."""
    period = config.front_end.steps.period
    assert period is not None
    first = min(float(log[name].times[0]) for name in ("panning", "vertical")) + period
    judge = Judge(log, first, submap_lift(config.front_end.submap))
    return SE3.compose(np.asarray(log.meta["T_world_frame"], dtype=np.float64), judge.base)


def seam(merged: MergedSubmaps, k: int, name: str, true: Array) -> Iterator[Measurement]:
    """First base of a session in the frame of the first session: error, NEES, and number of constraints."""
    s = merged.sessions[k]
    e = SE3.log(SE3.between(s.T_world_base, true))
    yield Measurement(name, "seam_error", float(np.linalg.norm(e[3:])))
    yield Measurement(name, "seam_sigma", float(np.sqrt(np.trace(s.covariance[3:, 3:]))))
    yield Measurement(name, "seam_heading", float(np.rad2deg(abs(e[2]))))
    d2 = float(e @ np.linalg.solve(s.covariance, e))
    yield Measurement(name, "seam_nees", d2 / 6.0)
    within = d2 <= stats.chi2.ppf(THREE_SIGMA, 6)
    yield Measurement(name, "seam_within_3_sigma", float(within))
    assert s.attached is not None
    yield Measurement(name, "links", float(len(s.attached.used)))
    yield Measurement(name, "links_dropped", float(s.attached.dropped))
