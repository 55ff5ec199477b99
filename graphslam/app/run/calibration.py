"""The quick calibration inside a run: what it may look at, when it is made, and what it says."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from graphslam.calibrate.calibrate import calibrate_log
from graphslam.calibrate.corrections import CalibrateConfig, Corrections, calibrated
from graphslam.calibrate.estimate import Calibration
from graphslam.calibrate.sighted import QUICK, Effort
from graphslam.core.errors import DataError, GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.log import SensorLog
from graphslam.frontends.base import FrontEnd

OWN = "Noise and lasting errors are those of the settings made for this very set; nothing was estimated from the log."


def prepared(
    log: SensorLog, front: FrontEnd, config: CalibrateConfig, options: Mapping[str, Any], *, own: bool, seed: int
) -> tuple[SensorLog, CalibrateConfig, list[Finding], Calibration | None]:
    """The log as the front end is to see it, the figures that were applied to it, and what is to be said.

    Parameters
    ----------
    log : SensorLog
    front : FrontEnd
    config : CalibrateConfig
    options : mapping
        What the user asked for: noise that is set by hand stays.
    own : bool
        Is there a preset for this very set?
    seed : int
    """
    if config.given is not None:
        said = [Finding("", "calibrated", "Noise and lasting errors are those given in calibrate.given.")]
        return calibrated(log, config.given), config, said, None
    if config.use == "none" or not looks_at(front):
        return log, config, [], None
    if config.use == "auto" and own:
        return log, config, [Finding("", "calibrated", OWN)], None
    effort = replace(QUICK, poses=max(int(QUICK.poses * config.budget), 100))
    try:
        found = calibration(log, front, effort, seed=seed)
        given = chosen(found.corrections, front, options)
        return calibrated(log, given), replace(config, given=given), found.findings(), found
    except GraphSlamError as error:
        said = [Finding("", "calibrated", f"Noise could not be told from the log: {error}. Its defaults are used.")]
        return log, config, said, None


def looks_at(front: FrontEnd) -> bool:
    """Does the front end read what can be calibrated: sightings of landmarks?"""
    return front_kind(front) is not None


def front_kind(front: FrontEnd) -> str | None:
    """``sightings`` or ``scans``, whichever the front end reads."""
    hints = typing.get_type_hints(type(front.config))
    if {"noise", "association"} <= set(hints):
        return "sightings"
    return "scans" if "steps" in hints else None


def calibration(log: SensorLog, front: FrontEnd, effort: Effort, *, seed: int = 0) -> Calibration:
    """What the log says of its noise, of the streams that the front end reads.

    Raises
    ------
    DataError, MissingDataError
        The log says nothing.
    """
    kind = front_kind(front)
    if kind is None:
        raise DataError(f"front end {front.name} reads nothing that can be calibrated", where=log.name)
    return calibrate_log(log, kind, effort, front.config, seed=seed)


def chosen(c: Corrections, front: FrontEnd, options: Mapping[str, Any]) -> Corrections:
    """What of a calibration is used where the user has set noise by hand."""
    own = options.get("frontend", {})
    if "motion" in own:
        c = c.without_motion_noise()
    if "noise" in own or "smoothing_noise" in own:
        c = c.without_sensor_noise()
    return c
