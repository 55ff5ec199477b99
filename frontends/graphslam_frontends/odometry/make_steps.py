"""Conversion of sensor data of any robot to steps, the input of grid front ends.

A step is a short time interval: the motion that ends at its stamp and the beams of the interval, deskewed to the base
frame at the stamp. Grid front ends use nothing else.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import ConfigError, DataError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.range_scans import RangeScans
from graphslam.core.records import LaserScans
from graphslam_frontends.odometry.deskew import (
    BeamSource,
    Index,
    assign_steps,
    beam_source,
    cut_beams,
    deskew_beams,
    stratified_indices,
)
from graphslam_frontends.odometry.motion_source import MotionSource, motion_source
from graphslam_frontends.odometry.scan_matching import match_neighbours
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps

_log = logging.getLogger(__name__)
_MOST_STEPS = 1_000_000
CLOUD_RANGE = 60.0
"""Range of lidars whose clouds do not give one [m]."""


def make_steps(log: SensorLog, config: StepConfig | None = None, *, drops: DropCounter | None = None) -> Steps:
    """Cut a log into steps.

    A step has the beams after the stamp of the previous step, up to its own stamp, each deskewed to the step's stamp.
    With a ``period`` the first step begins with the first beam and the last may be shorter; steps without beams are
    kept for their motion. Without a period there is one step for every record of the first scanner.

    Parameters
    ----------
    log : SensorLog
    config : StepConfig, optional
    drops : DropCounter, optional
        Counts invalid beams and scans, beams outside the motion, beams removed by subsampling, steps without a beam,
        and bridged gaps.

    Returns
    -------
    Steps
    """
    config = config or StepConfig()
    count = DropCounter()
    names = config.scanners or scanner_names(log)
    source = motion_source(log, config, 2 if isinstance(log[names[0]], LaserScans) else 3)
    sources = BeamSources(log, names, source, config, count)
    beam_times, inside = sources.times, sources.inside
    outside = len(inside) - int(inside.sum())
    if len(inside) and outside > 0.5 * len(inside):
        raise DataError(
            f"{outside} of {len(inside)} beams lie outside the motion: are the clocks the same?",
            where=f"{log.name}: {', '.join(names)}",
            got=f"{beam_times.min():.3f} to {beam_times.max():.3f} s",
            wanted=f"{source.begin:.3f} to {source.end:.3f} s, as {', '.join(source.names)}",
        )
    count.drop(", ".join(names), "beams without odometry at their time", outside)
    skipped = sources.skipped
    skipped = skipped[(skipped >= source.begin) & (skipped <= source.end)]
    times, begin = _stamps(log[names[0]], np.append(beam_times[inside], skipped), source, config)
    steps = cut_steps(log, sources, times, begin, config)
    if config.level_floors:
        steps = replace(steps, tilt=level_on_the_whole(steps.tilt, steps.odometry.increments))
    for what, n in count.counts.items():
        _log.info("%s: %s: %d", log.name, what, n)
    if drops is not None:
        drops.counts.update(count.counts)
    return match_neighbours(steps, drops=drops) if config.match_scans else steps


class BeamSources:
    """The beams of the scanners of a log, and the motion to deskew them with.

    Parameters
    ----------
    names : tuple of str
        Scanners.
    drops : DropCounter
        Counts omitted beams and scans.
    """

    def __init__(
        self, log: SensorLog, names: tuple[str, ...], motion: MotionSource, config: StepConfig, drops: DropCounter
    ) -> None:
        self.names, self.motion, self.drops = names, motion, drops
        self.of = _beam_sources(log, names, motion, config, drops)
        self.times = np.concatenate([s.times for s in self.of])
        self.inside = (self.times >= motion.begin) & (self.times <= motion.end)
        self.skipped = np.concatenate([s.skipped for s in self.of])

    def times_with_skipped(self) -> Array:
        """Stamps of all beams and of the scans left out as repetitions [s]."""
        return np.append(self.times, self.skipped)


def cut_steps(log: SensorLog, sources: BeamSources, times: Array, begin: float, config: StepConfig) -> Steps:
    """Steps that end at ``times`` ``(n,)``, the first from ``begin`` on [s], without options for the whole log."""
    names, source, count = sources.names, sources.motion, sources.drops
    beam_times, inside = sources.times, sources.inside
    used = inside & (beam_times >= begin) & (beam_times <= times[-1])
    motion = source.solve(times, np.unique(np.append(beam_times[used], begin)), count)
    step = assign_steps(beam_times, times, begin)
    step[~inside] = -1
    if config.silent == "unknown":
        silent = np.concatenate([~s.beams(np.arange(len(s.times)))[2] for s in sources.of]) & inside
        step[silent] = -1
        count.drop(", ".join(names), "beams without a range", int(silent.sum()))
    chosen, offsets, thinned = _choose(step, len(times), config.most_points)
    count.drop(", ".join(names), f"beams thinned out ({config.most_points} per step kept)", thinned)
    count.drop("steps", "step without a beam (kept)", int(np.sum(np.diff(offsets) == 0)))
    origins, ends, met = _beams(sources.of, chosen, config)
    origins, ends = deskew_beams(motion.path, motion.poses, step[chosen], beam_times[chosen], origins, ends)
    return Steps(
        times=times,
        odometry=motion.odometry,
        offsets=offsets,
        points=ends,
        origins=origins,
        returns=met,
        max_range=config.max_range or max(s.max_range for s in sources.of),
        range_sigma=max(s.sigma for s in sources.of),
        ages=times[step[chosen]] - beam_times[chosen],
        tilt=motion.tilt,
        tilt_sigma=motion.tilt_sigma,
        tilt_time=motion.tilt_time,
        uses=frozenset((*source.names, *names)),
        name=log.name + (f" (yaw rate off by {config.yaw_bias:g} rad/s)" if config.yaw_bias else ""),
        truth=log.truth.trajectory if log.truth is not None else None,
        errors=motion,
        gaps=motion.gaps,
    )


def level_on_the_whole(tilt: Array | None, increments: Array) -> Array | None:
    """Roll and pitch ``(n, 2)`` [rad] minus their median over the steps in which the body moved.

    On level floors the body is level at any heading. If ramps are less than half of the path, and go up as often as
    down, the median is the constant error of gravity.
    """
    if tilt is None:
        return None
    length = np.linalg.norm(increments[:, :3], axis=1)
    moved = length > 0.5 * float(np.median(length))
    return tilt - np.median(tilt[moved if moved.any() else slice(None)], axis=0)


def scanner_names(log: SensorLog) -> tuple[str, ...]:
    """Default beam streams for steps."""
    for kind in (RangeScans, PointClouds, LaserScans):
        names = tuple(name for name, s in log.streams.items() if isinstance(s, kind))
        if names:
            return names
    raise MissingDataError("no scanner to make steps of", where=log.name, wanted="RangeScans, PointClouds, LaserScans")


def _beam_sources(
    log: SensorLog, names: tuple[str, ...], motion: MotionSource, config: StepConfig, drops: DropCounter
) -> list[BeamSource]:
    sources = []
    for name in names:
        stream = log[name]
        if not isinstance(stream, RangeScans | PointClouds | LaserScans):
            raise ConfigError(f"steps: stream {name!r} holds no beams; got {type(stream).__name__}")
        source = beam_source(
            stream,
            name,
            min_range=config.min_range,
            range_sigma=config.range_sigma,
            cloud_range=CLOUD_RANGE,
            drops=drops,
        )
        if source.dim != motion.dim:
            raise ConfigError(
                f"steps: {name!r} has {source.dim} dimensions, the motion of {', '.join(motion.names)} {motion.dim}"
            )
        sources.append(source)
    return sources


def _stamps(
    first: RangeScans | PointClouds | LaserScans, beams: Array, source: MotionSource, config: StepConfig
) -> tuple[Array, float]:
    """Stamps of the steps and start of the first; ``beams``: times of those inside the motion."""
    if config.period is None:
        last = first.beam_times[-1] if isinstance(first, RangeScans) and len(first.beam_times) else 0.0
        whole = (first.times >= source.begin) & (first.times + last <= source.end)
        if not np.any(whole):
            raise DataError("no record of the scanner lies inside the motion", got=len(first.times))
        return first.times[whole] + last, float(first.times[whole][0])
    if len(beams):
        begin, end = float(beams.min()), float(beams.max())
    else:  # no valid beam at all: use the interval of the motion
        begin, end = source.begin, source.end
    n = int(np.floor((end - begin) / config.period + 1e-9))
    if n > _MOST_STEPS:
        source.solve(np.array([begin, end]), np.zeros(0), None)  # raises for a long gap, if that is the reason
        raise DataError(
            f"{n} steps", got=f"{end - begin:.0f} s in steps of {config.period} s", wanted=f"≤ {_MOST_STEPS}"
        )
    times = np.minimum(begin + config.period * np.arange(1, n + 1), end)
    if n == 0 or end - times[-1] > 1e-6:
        times = np.append(times, end)
    else:
        times[-1] = end  # not before the last beam by rounding
    return times, begin


def _choose(step: Index, n: int, most: int) -> tuple[Index, Index, int]:
    """Numbers of the selected beams, by step ``(k,)``; offsets ``(n + 1,)``; number left out."""
    order = np.argsort(step, kind="stable")
    bounds = np.searchsorted(step[order], np.arange(n + 1))
    kept = [order[a:b][stratified_indices(int(b - a), most)] for a, b in pairwise(bounds)]
    offsets = np.concatenate([[0], np.cumsum([len(k) for k in kept])]).astype(np.int64)
    chosen = np.concatenate(kept) if kept else np.zeros(0, dtype=np.int64)
    return chosen.astype(np.int64), offsets, int(bounds[-1] - bounds[0] - offsets[-1])


def _beams(sources: list[BeamSource], chosen: Index, config: StepConfig) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Origins, ends and returns of the selected beams, base at their own time, cut at the maximum range."""
    dim = sources[0].dim
    origins, ends, met = np.empty((len(chosen), dim)), np.empty((len(chosen), dim)), np.zeros(len(chosen), np.bool_)
    first = 0
    for s in sources:
        rows = np.flatnonzero((chosen >= first) & (chosen < first + len(s.times)))
        rows = rows[np.argsort(chosen[rows], kind="stable")]
        origins[rows], far, hit = s.beams(chosen[rows] - first)
        ends[rows], met[rows] = cut_beams(origins[rows], far, hit, min(config.max_range or np.inf, s.max_range))
        first += len(s.times)
    return origins, ends, met
