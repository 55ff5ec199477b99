"""Quick calibration inside a run: when it is made, which streams it uses, and its findings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.front_ends import make_front_end, recommended_options
from graphslam.app.run.source import load
from graphslam.calibrate.calibrate import CALIBRATIONS
from graphslam.calibrate.corrections import CalibrateConfig, Corrections, apply_corrections, moved_end
from graphslam.calibrate.estimate import NAMES, SIGNIFICANT, Calibration, estimate_text
from graphslam.calibrate.landmark_calibration import FULL, QUICK, CalibrationBudget, calibrate_observations
from graphslam.calibrate.windows import ObservationLog
from graphslam.core.config import merge_options
from graphslam.core.errors import DataError, GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations
from graphslam.evaluate.residual_consistency import two_sided_bounds
from graphslam.graph.factor_graph import FactorGraph
from graphslam_frontends.base import FrontEnd
from graphslam_frontends.mixed import MixedFrontEnd
from graphslam_frontends.odometry.motion import MotionNoise

LANDMARKS, SCANS = "rbpf-ekf", "segslam"
"""Front ends whose settings are used to read a log of landmarks, or of scans, if no front end is named."""
CERTAIN, DISAGREE = 0.999, 1.5
"""If χ² per degree of freedom of the join is above both limits, the submaps disagree and a cause is searched."""
OWN = "noise and calibration: preset of this data set — not estimated from the log."


def apply_calibration(
    log: SensorLog, front: FrontEnd, config: CalibrateConfig, options: Mapping[str, Any], *, own: bool, seed: int
) -> tuple[SensorLog, CalibrateConfig, list[Finding], Calibration | None]:
    """The corrected log, the calibration options, findings, and the estimate.

    Parameters
    ----------
    options : mapping
        Options set by the user; noise that is set here is kept.
    own : bool
        There is a preset for this data set.
    """
    if isinstance(front, MixedFrontEnd):
        front = front.calibrated_part
        options = {"frontend": options.get("frontend", {}).get(front.name, {})}
    lines, found = [], None
    if config.given is not None:  # values given by the user have priority over an estimate
        config = replace(config, given=keep_user_settings(config.given, options))
        lines = [Finding("", "calibrated", "noise and calibration: calibrate.given — not estimated from the log.")]
    elif config.use == "auto" and own and front.calibrates:
        lines = [Finding("", "calibrated", OWN)]
    elif config.use != "none" and front.calibrates:
        effort = replace(QUICK, poses=max(int(QUICK.poses * config.budget), 100))
        try:
            found = calibrate_for_front_end(log, front, effort, seed=seed)
            config, lines = replace(config, given=keep_user_settings(found.corrections, options)), found.findings()
        except GraphSlamError as error:
            lines = [Finding("", "calibrated", f"noise: default values — not estimated from the log: {error}.")]
    if config.given is None:
        return log, config, lines, found
    corrected = apply_corrections(log, config.given)
    return corrected, config, [*lines, *_path_moved(log, corrected, config.given, front)], found


def _path_moved(log: SensorLog, corrected: SensorLog, c: Corrections, front: FrontEnd) -> list[Finding]:
    """A finding if the end of the corrected path differs from that of the log by more than the noise of both allows."""
    if c.without_constants() == c:
        return []
    moved, allowed = moved_end(log, corrected, getattr(front.config, "motion", None) or MotionNoise())
    if moved <= allowed:
        return []
    text = (
        f"dead reckoning: the calibrated path ends {moved:.3g} m from that of the log [≤ {allowed:.2g} m by the noise "
    )
    text += "of both] — one of them is wrong. To do: check one distance, or run again with --set calibrate.use=none."
    return [Finding("look", "calibration-path", text)]


def calibrate_log(
    source: str | Path | SensorLog,
    *,
    frontend: str | None = None,
    quick: bool = False,
    seed: int = 0,
    config: Mapping[str, Any] | None = None,
    reader: str | None = None,
    reader_options: Mapping[str, Any] | None = None,
    preset: str | None = None,
) -> Calibration:
    """Estimate sensor noise and systematic errors from a log (no ground truth, no noise of a preset).

    Parameters
    ----------
    source : data set name, folder, or SensorLog
    frontend : str, optional
        Front end that reads the log. Default: by the streams of the log.
    quick : bool
        Use a part of the log, as inside a run (a few seconds).
    seed : int
    config : mapping, optional
        Options that override the source's preset, as for a run: how scans and landmarks are read.
    reader, reader_options, preset
        As for a run.

    Returns
    -------
    Calibration
        ``corrections`` [SI units, rad], σ of each, ``config()`` for :func:`run`, and reasons for missing estimates.

    Raises
    ------
    GraphSlamError
        Or one of its children: the log does not determine its noise.

    Examples
    --------
    >>> found = gs.calibrate_log(log, quick=True)
    >>> again = gs.run(log, config={"calibrate": found.config()}, progress=False)
    """
    log = load(source, reader=reader, **(reader_options or {}))
    name = frontend or (LANDMARKS if log.of_type(LandmarkObservations) else SCANS)
    options = merge_options(recommended_options(log, name, preset), config or {})
    front = make_front_end(name, options.get("frontend", {}))
    with one_blas_thread():
        return calibrate_for_front_end(log, front, QUICK if quick else FULL, seed=seed)


def uses_preset_noise(options: Mapping[str, Any]) -> bool:
    """Is the noise of the preset used? False with ``calibrate.given`` or ``calibrate.use = "always"``."""
    asked = options.get("calibrate", {})
    return not isinstance(asked, Mapping) or ("given" not in asked and asked.get("use", "auto") != "always")


def without_noise(suggested: Mapping[str, Any], *, mixed: bool = False) -> dict[str, Any]:
    """A preset without its sensor noise and constants; settings for reading the log stay.

    ``mixed``: the preset is for several front ends, with options under their names.
    """
    front = _without_front_noise(suggested.get("frontend", {}))
    if mixed:
        front = {k: _without_front_noise(v) for k, v in suggested.get("frontend", {}).items()}
    back = {k: v for k, v in suggested.get("backend", {}).items() if k != "covariance_scale"}
    kept = {"frontend": front, "backend": back}
    return {**suggested, **{k: v for k, v in kept.items() if k in suggested}}


def _without_front_noise(options: Mapping[str, Any]) -> dict[str, Any]:
    front = {k: v for k, v in options.items() if k not in ("motion", "noise", "smoothing_noise")}
    if isinstance(front.get("steps"), Mapping):
        front["steps"] = {k: v for k, v in front["steps"].items() if k != "yaw_per_metre"}
    return front


def calibrate_for_front_end(
    log: SensorLog, front: FrontEnd, effort: CalibrationBudget, *, seed: int = 0
) -> Calibration:
    """Estimate noise and systematic errors of the streams that a front end uses."""
    if front.calibrates not in CALIBRATIONS:
        raise DataError(f"front end {front.name} has no data to calibrate", where=log.name)
    return CALIBRATIONS[front.calibrates](log, front.config, effort, seed)


def explain_disagreement(
    log: SensorLog, config: CalibrateConfig, chi2_per_dof: float | None, dof: float, *, ranges_corrected: bool
) -> list[Finding]:
    """Systematic sensor errors of a log that was mapped without calibration and whose submaps disagree.

    Parameters
    ----------
    chi2_per_dof, dof : float
        Of the join of the submaps.
    ranges_corrected : bool
        The settings correct the ranges themselves.
    """
    name = log.of_type(LandmarkObservations)
    if config.given is not None or name is None or chi2_per_dof is None or not dof > 0:
        return []
    if not chi2_per_dof > max(two_sided_bounds(chi2_per_dof, dof, CERTAIN)[1], DISAGREE):
        return []
    try:
        found = calibrate_observations(ObservationLog.of(log, name, log[name]), QUICK)
    except GraphSlamError:
        return []
    own = ("range_scale", "range_offset") if ranges_corrected else ()
    out = []
    for e in found.estimates:
        if e.applied and e.name not in own:
            text = f"{estimate_text(e.name, e.value, e.sigma)} — a cause of the disagreement between submaps "
            text += f"(log-likelihood +{e.gain:.0f} nats). To do: --set calibrate.use=always, or `graphslam calibrate`."
            out.append(Finding("bad", "calibration", text))
    return out


def bias_table(graph: FactorGraph) -> list[dict[str, Any]]:
    """One row per constant error that was estimated with the map: name, value, σ, and prior σ."""
    out = []
    for robot, event in enumerate(e for e in graph.events if e["event"] == "biases"):
        g, P = graph.sensor_biases(robot)
        rows = zip(event["names"], g.tolist(), np.sqrt(np.diag(P)).tolist(), event["sigmas"])
        out += [{"name": n, "value": v, "sigma": s, "beforehand": b, "robot": robot} for n, v, s, b in rows if n]
    return out


def bias_findings(facts: Sequence[Mapping[str, Any]]) -> list[Finding]:
    """Findings on the constant errors that were estimated with the map."""
    significant = [r for r in facts if abs(r["value"]) > SIGNIFICANT * r["sigma"]]
    wild = [r for r in significant if abs(r["value"]) - SIGNIFICANT * r["sigma"] > SIGNIFICANT * r["beforehand"]]
    if not facts:
        return []
    estimates = [estimate_text(r["name"], r["value"], r["sigma"]) for r in significant]
    rest = [f"± {_sigma_in_words(r)}" for r in facts if r not in significant]
    text = f"systematic errors estimated with the map: {'; '.join(estimates) or 'none significant'}"
    text += f" — not significant: {', '.join(rest)}." if rest else "."
    text += " The covariances include their uncertainty."
    out = [Finding("", "biases", text)]
    if wild:
        text = f"{'; '.join(estimate_text(r['name'], r['value'], r['sigma']) for r in wild)} — implausibly large. "
        text += "To do: check unit, sign and mounting of the sensor; `graphslam data check`."
        out.append(Finding("bad", "biases", text))
    return out


def _sigma_in_words(row: Mapping[str, Any]) -> str:
    s, name = row["sigma"], row["name"]
    if name == "yaw_bias":
        return f"{np.rad2deg(s):.3f} deg/s of the yaw rate"
    if name == "turn_per_metre":
        return f"{np.rad2deg(s):.3f} deg/m of the turns"
    if name == "sensor_yaw":
        return f"{np.rad2deg(s):.2f} deg of the sensor yaw"
    if name.startswith("mount"):
        return f"{s:.3f} m of the sensor position ({'forward' if name == 'mount_x' else 'left'})"
    return f"{s:.3f} m of the ranges" if name == "range_offset" else f"{100 * s:.2f} % of {NAMES[name]}"


def keep_user_settings(c: Corrections, options: Mapping[str, Any]) -> Corrections:
    """The part of a calibration that does not override noise or constants set by the user or in an options file.

    No parameter is corrected twice: a constant that is in the options is not estimated as well.
    """
    own = options.get("frontend", {})
    noise = {**(own.get("noise") or {}), **(own.get("smoothing_noise") or {})}
    if "motion" in own:
        c = c.without_motion_noise()
    if noise:
        c = c.without_sensor_noise()
    if {"range_scale", "range_offset"} & set(noise):
        c = replace(c, range_scale=1.0, range_offset=0.0)
    if "yaw_per_metre" in own.get("steps", {}):
        c = replace(c, turn_per_metre=0.0)
    return c
