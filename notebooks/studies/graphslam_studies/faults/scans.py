"""Faults put into a log of a scanner, wheels and an IMU: each a function from a log to a log.

The logs have no ground truth: the run has only its own tests.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from graphslam.core import se3
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.records import LaserScans

Inject = Callable[[SensorLog], SensorLog]


def put(log: SensorLog, **streams: Any) -> SensorLog:
    """The log with streams in place of those of these names, without truth."""
    return replace(log, streams={**log.streams, **streams}, truth=None)


def clean(log: SensorLog) -> SensorLog:
    """No fault: only the truth is taken away."""
    return replace(log, truth=None)


# ---- scans -----------------------------------------------------------------------------------------------------------


def ranges(change: Callable[[Array], Array]) -> Inject:
    """Every range changed; no-returns stay what they are, and what goes beyond max_range is one."""

    def inject(log: SensorLog) -> SensorLog:
        s = log["scanner"]
        met = s.ranges < s.max_range
        r = np.where(met, np.minimum(change(s.ranges), s.max_range), s.ranges)
        return put(log, scanner=replace(s, ranges=r.astype(s.ranges.dtype)))

    return inject


def every(value: float) -> Inject:
    """All ranges of all scans are one number."""

    def inject(log: SensorLog) -> SensorLog:
        s = log["scanner"]
        return put(log, scanner=replace(s, ranges=np.full_like(s.ranges, s.max_range if value < 0 else value)))

    return inject


def no_scan(log: SensorLog) -> SensorLog:
    """A scanner without a record."""
    return put(log, scanner=log["scanner"].take(slice(0, 0)))


def blind(seconds: float, at: float = 12.0) -> Inject:
    """All beams without a reading for some seconds."""

    def inject(log: SensorLog) -> SensorLog:
        s = log["scanner"]
        r = s.ranges.copy()
        r[(s.times > at) & (s.times < at + seconds)] = np.nan
        return put(log, scanner=replace(s, ranges=r))

    return inject


def gap(stream: str, seconds: float, at: float = 8.0) -> Inject:
    """No record of a stream for some seconds."""

    def inject(log: SensorLog) -> SensorLog:
        s = log[stream]
        return put(log, **{stream: s.take((s.times <= at) | (s.times >= at + seconds))})

    return inject


def twice(log: SensorLog) -> SensorLog:
    """Every second scan is the one before."""
    s = log["scanner"]
    return put(log, scanner=replace(s, ranges=np.repeat(s.ranges[::2], 2, axis=0)[: len(s.times)]))


def stuck(log: SensorLog) -> SensorLog:
    """The scan of the tenth second goes on for ever."""
    s = log["scanner"]
    k = int(np.searchsorted(s.times, 10.0))
    r = s.ranges.copy()
    r[k:] = r[k]
    return put(log, scanner=replace(s, ranges=r))


def bubble(log: SensorLog) -> SensorLog:
    """A scanner that sees its own housing: 3 m all round, with noise."""
    s = log["scanner"]
    r = 3.0 + 0.02 * np.random.default_rng(5).standard_normal(s.ranges.shape)
    return put(log, scanner=replace(s, ranges=r.astype(s.ranges.dtype)))


def mirrored(log: SensorLog) -> SensorLog:
    """Beams in reverse order."""
    s = log["scanner"]
    return put(log, scanner=replace(s, ranges=np.ascontiguousarray(s.ranges[:, ::-1])))


def mounted(x: float = 0.0, y: float = 0.0, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Inject:
    """A mounting that is stated wrong [m, degrees]."""

    def inject(log: SensorLog) -> SensorLog:
        s = log["scanner"]
        if isinstance(s, LaserScans):
            return put(log, scanner=replace(s, T_base_sensor=s.T_base_sensor + [x, y, np.deg2rad(yaw)]))
        T = np.array([x, y, 0.0, 0.0, 0.0, 0.0, 1.0])
        turn = se3.so3_exp(np.deg2rad([roll, pitch, yaw]))
        mount = s.T_base_mount.copy()
        mount[:3] += T[:3]
        mount[3:] = se3.quat_multiply(turn, mount[3:])
        return put(log, scanner=replace(s, T_base_mount=mount))

    return inject


def late(stream: str, seconds: float) -> Inject:
    """Stamps of one stream are off."""

    def inject(log: SensorLog) -> SensorLog:
        s = log[stream]
        return put(log, **{stream: replace(s, times=s.times + seconds)})

    return inject


def second_scanner_dead(log: SensorLog) -> SensorLog:
    """There are two scanners, and one of them gives no reading."""
    s = log["scanner"]
    return put(log, scanner2=replace(s, ranges=np.full_like(s.ranges, np.nan)))


# ---- wheels ----------------------------------------------------------------------------------------------------------


def speed(factor: float) -> Inject:
    """Every speed times a factor."""

    def inject(log: SensorLog) -> SensorLog:
        w = log["wheels"]
        return put(log, wheels=replace(w, speed=factor * w.speed))

    return inject


def yaw_rate(factor: float) -> Inject:
    """Every yaw rate of the wheels times a factor: -1 is left and right swapped."""

    def inject(log: SensorLog) -> SensorLog:
        w = log["wheels"]
        return put(log, wheels=replace(w, yaw_rate=factor * w.yaw_rate))

    return inject


# ---- IMU -------------------------------------------------------------------------------------------------------------


def gyro(factor: float) -> Inject:
    """Every rate times a factor."""

    def inject(log: SensorLog) -> SensorLog:
        i = log["imu"]
        return put(log, imu=replace(i, angular_rate=factor * i.angular_rate))

    return inject


def saturated(limit: float = 0.25) -> Inject:
    """Rates cut at a limit."""

    def inject(log: SensorLog) -> SensorLog:
        i = log["imu"]
        return put(log, imu=replace(i, angular_rate=np.clip(i.angular_rate, -limit, limit)))

    return inject


def swapped(order: tuple[int, int, int]) -> Inject:
    """Axes of the unit in another order."""

    def inject(log: SensorLog) -> SensorLog:
        i = log["imu"]
        rate, force = i.angular_rate[:, order], i.specific_force[:, order]
        return put(log, imu=replace(i, angular_rate=rate, specific_force=force))

    return inject


def in_g(log: SensorLog) -> SensorLog:
    """Specific force in units of gravity, and no attitude of its own."""
    i = log["imu"]
    return put(log, imu=replace(i, specific_force=i.specific_force / 9.80665, attitude=None))


def frozen(log: SensorLog) -> SensorLog:
    """The reading of the tenth second goes on for five."""
    i = log["imu"]
    k = np.arange(len(i.times))
    k[(i.times > 10.0) & (i.times < 15.0)] = int(np.searchsorted(i.times, 10.0))
    return put(log, imu=replace(i, angular_rate=i.angular_rate[k], specific_force=i.specific_force[k]))


# ---- the whole log ---------------------------------------------------------------------------------------------------


def first(records: int) -> Inject:
    """Only the first records of every stream."""

    def inject(log: SensorLog) -> SensorLog:
        return put(log, **{name: s.take(slice(0, records)) for name, s in log.streams.items()})

    return inject


def one_record(stream: str) -> Inject:
    """One record of a stream."""

    def inject(log: SensorLog) -> SensorLog:
        return put(log, **{stream: log[stream].take(slice(5, 6))})

    return inject
