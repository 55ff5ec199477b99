"""Faults of the study ``trust``: those of ``docs/faults.md`` that can be injected into a random world, one at a time.

Except for the fault the world is clean, and the run gets no information about it. The functions that change a log are
in :mod:`graphslam_studies.faults`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from graphslam.core.geometry import se2_exp, se2_log
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam_studies.faults import landmarks as a
from graphslam_studies.faults import scans as b
from graphslam_studies.trust_worlds import TrustWorld, draw_world, world_log

FIRST = 1200
"""Number of the first random world; worlds from here on were not used to develop rules or defaults."""
SECONDS = 80.0
TEN_DEGREES = float(np.deg2rad(10.0))


def odometry(distance: float = 1.0, turn: float = 1.0, bias: float = 0.0, slip: float = 1.0) -> a.Inject:
    """Fault: factors on distances and turns, yaw-rate bias [rad/s], factor ``slip`` on distances in 1 s of 10 s."""

    def inject(log: SensorLog) -> SensorLog:
        o = log["odometry"]
        twist = se2_log(o.increments) * [distance, distance, turn]
        twist[:, 2] += bias * np.diff(o.times, prepend=o.times[0])
        twist[o.times % 10.0 < 1.0, :2] *= slip
        return a.with_stream(log, "odometry", replace(o, increments=se2_exp(twist)))

    return inject


def both(first: a.Inject, second: a.Inject) -> a.Inject:
    """Two faults at once."""
    return lambda log: second(first(log))


ODOMETRY: Mapping[str, a.Inject] = {
    "odometry: distances × 1.05": odometry(distance=1.05),
    "odometry: distances × 2": odometry(distance=2.0),
    "odometry: in km/h (× 3.6)": odometry(distance=3.6),
    "odometry: no motion": a.increments(0.0),
    "odometry: backwards": a.increments(-1.0),
    "odometry: turns × 1.05": odometry(turn=1.05),
    "odometry: turns mirrored": odometry(turn=-1.0),
    "odometry: turns in degrees": odometry(turn=180.0 / np.pi),
    "odometry: yaw rate off by 1 °/s": odometry(bias=float(np.deg2rad(1.0))),
    "odometry: wheels slip for 1 s of 10": odometry(slip=1.5),
    "odometry: 10 s lost": a.odometry_gap(10.0, at=40.0),
    "odometry: covariance × 0.01": a.stated_covariance(0.01),
    "odometry: late by 0.5 s": b.late("odometry", 0.5),
    "log: 10 s of all lost": a.gap_of_all(10.0, at=40.0),
}
OBSERVATIONS: Mapping[str, a.Inject] = {
    "landmarks: ranges × 1.05": a.ranges(1.05),
    "landmarks: ranges × 2": a.ranges(2.0),
    "landmarks: ranges in mm": a.ranges(1000.0),
    "landmarks: ranges + 1 m": a.ranges(1.0, 1.0),
    "landmarks: ranges constant": a.constant_ranges(7.0),
    "landmarks: bearings mirrored": a.mirrored(),
    "landmarks: bearings + 10°": a.bearing_offset(TEN_DEGREES),
    "landmarks: bearings in degrees": a.bearings_in_degrees(),
    "landmarks: sensor 1 m to the side": a.mounted(0.0, 1.0, 0.0),
    "landmarks: 10 % wrong ids": a.wrong_identities(0.1),
    "landmarks: every scan ten times": a.repeated(10),
    "landmarks: late by 0.5 s": b.late("landmarks", 0.5),
    "landmarks: 30 s lost": b.gap("landmarks", 30.0, at=40.0),
    "both: distances and ranges × 1.05": both(odometry(distance=1.05), a.ranges(1.05)),
    "both: turns and bearings mirrored": both(odometry(turn=-1.0), a.mirrored()),
}
GPS: Mapping[str, a.Inject] = {
    "GPS: another time base": b.late("gps", 1e6),
    "GPS: late by 1 s": b.late("gps", 1.0),
    "GPS: stuck": a.gps(lambda g, _: replace(g, positions=np.tile(g.positions[0], (len(g.times), 1)))),
    "GPS: degrees": a.gps(a.degrees),
    "GPS: axes swapped": a.gps(a.axes_swapped),
    "GPS: bursts of outliers": a.gps(a.bursts),
    "GPS: jumps by 10 m, for good": a.gps(
        lambda g, _: replace(g, positions=g.positions + np.where(g.times > 40.0, 1.0, 0.0)[:, None] * [8.0, 6.0])
    ),
    "GPS: drifts by 7 m": a.gps(a.ramp),
    "GPS: 3 m for 60 s, σ of the noise": a.gps(a.correlated(0.3)),
    "GPS: 3 m for 60 s, σ of all of it": a.gps(a.correlated(3.0)),
    "GPS: off by 1 km": a.gps(a.off_by_1_km),
}


@dataclass(frozen=True)
class FaultWorld:
    """A clean random world with one fault.

    Parameters
    ----------
    world : TrustWorld
        Clean.
    wrong : str
        Name of the fault.
    """

    world: TrustWorld
    wrong: str
    clean: bool = False

    @property
    def gps(self) -> str:
        """Kind of GPS receiver of the world."""
        return self.world.gps

    def log(self, seed: int) -> SensorLog:
        """A log with the fault; its ground truth is that of the world."""
        log = world_log(self.world, SeedTree(seed))
        return replace(FAULTS[self.wrong](log), truth=log.truth)


FAULTS: Mapping[str, a.Inject] = {**ODOMETRY, **OBSERVATIONS, **GPS}


def fault_worlds() -> dict[str, FaultWorld]:
    """One world per fault: with white-noise fixes for GPS faults, else without fixes."""
    out = {}
    for k, name in enumerate(FAULTS):
        world = replace(draw_world(FIRST + 4 * k, seconds=SECONDS), gps="white" if name in GPS else "none")
        out[f"fault-{k:02d}"] = FaultWorld(world, name)
    return out
