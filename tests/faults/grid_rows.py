"""The fault matrix of the front ends on grids: what is wrong, and what a user then sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from graphslam_studies.faults import scans as put

Outcome = Literal["refused", "dropped", "handled", "reported"]


@dataclass(frozen=True)
class Row:
    """One fault.

    Parameters
    ----------
    sensor, fault : str
    inject : callable
    outcome : str
    sign : str
        Of a refusal, words of the message; of records dropped, the reason; of a report, one of the codes (by ``|``).
    dims : tuple of int
    options : mapping
        Of the run besides.
    """

    sensor: str
    fault: str
    inject: put.Inject
    outcome: Outcome
    sign: str = ""
    dims: tuple[int, ...] = (2, 3)
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """For test names and the page."""
        return f"{self.sensor}: {self.fault}"


NONE_MET = "no beam of any scan met anything"
MOUNT = "mounting-disagrees|turn-disagrees|distance-disagrees"

ROWS = (
    Row("scanner", "all beams without a reading", put.every(np.nan), "refused", NONE_MET),
    Row("scanner", "all beams at max_range", put.every(-1.0), "refused", NONE_MET),
    Row("scanner", "no record at all", put.no_scan, "refused", NONE_MET),
    Row("scanner", "ranges × 1000 (millimetres)", put.ranges(lambda r: 1000.0 * r), "refused", NONE_MET),
    Row("scanner", "ranges × 0.001 (kilometres)", put.ranges(lambda r: 0.001 * r), "refused", NONE_MET),
    Row("scanner", "all ranges 3 m exactly", put.every(3.0), "reported", "scans-constant"),
    Row("scanner", "all ranges 3 m with noise", put.bubble, "reported", "distance-disagrees"),
    Row("scanner", "the same scan always", put.stuck, "reported", "scans-repeated"),
    Row("scanner", "every scan twice", put.twice, "dropped", "scan equal to the one before"),
    Row("scanner", "ranges × 2", put.ranges(lambda r: 2.0 * r), "reported", "distance-disagrees|scans-unlike"),
    Row("scanner", "ranges 1 m too long", put.ranges(lambda r: r + 1.0), "reported", f"{MOUNT}|scans-unlike", (3,)),
    Row("scanner", "ranges 1 m too long", put.ranges(lambda r: r + 1.0), "handled", "", (2,)),
    Row("scanner", "beams in reverse order", put.mirrored, "reported", MOUNT),
    Row("scanner", "turned by 10°", put.mounted(yaw=10.0), "reported", "mounting-disagrees"),
    Row("scanner", "pitched by 10°", put.mounted(pitch=10.0), "reported", "mounting-disagrees", (3,)),
    Row("scanner", "rolled by 10°", put.mounted(roll=10.0), "handled", "", (3,)),
    Row("scanner", "1 m off sideways", put.mounted(y=1.0), "reported", MOUNT),
    Row("scanner", "no reading for 10 s", put.blind(10.0), "reported", "motion-uncorrected"),
    Row("scanner", "gap of 5 s", put.gap("scanner", 5.0), "reported", "motion-uncorrected"),
    Row("scanner", "gap of 10 s", put.gap("scanner", 10.0), "reported", "motion-uncorrected"),
    Row("scanner", "gap of 30 s", put.gap("scanner", 30.0), "reported", "motion-uncorrected"),
    Row("scanner", "stamps 0.5 s late", put.late("scanner", 0.5), "reported", "clocks-disagree"),
    Row("scanner", "stamps of another time base", put.late("scanner", 1e6), "refused", "are the clocks the same"),
    Row("scanner", "a second one that is dead", put.second_scanner_dead, "reported", "scans-silent"),
    Row("wheels", "speed × 2", put.speed(2.0), "reported", "distance-disagrees"),
    Row("wheels", "speed 0", put.speed(0.0), "reported", "wheels-still"),
    Row("wheels", "speed × −1", put.speed(-1.0), "reported", "distance-disagrees"),
    Row("wheels", "speed × 3.6 (km/h)", put.speed(3.6), "reported", "distance-disagrees|scans-unlike"),
    Row("wheels", "left and right swapped", put.yaw_rate(-1.0), "reported", "turn-disagrees|turns-disagree"),
    Row("wheels", "yaw rate in degrees", put.yaw_rate(180.0 / np.pi), "reported", "turn-disagrees|turns-disagree"),
    Row("wheels", "gap of 5 s", put.gap("wheels", 5.0), "reported", "motion-gap"),
    Row("wheels", "gap of 10 s", put.gap("wheels", 10.0), "reported", "motion-gap"),
    Row("wheels", "gap of 30 s", put.gap("wheels", 30.0), "refused", "frontend.steps.longest_record"),
    Row("wheels", "one record", put.one_record("wheels"), "refused", "motion"),
    Row("IMU", "gyro in degrees per second", put.gyro(180.0 / np.pi), "reported", "turns-disagree", (3,)),
    Row("IMU", "gyro of the wrong sign", put.gyro(-1.0), "reported", "turn-disagrees|turns-disagree", (3,)),
    Row("IMU", "gyro saturated", put.saturated(), "reported", "imu-saturated", (3,)),
    Row("IMU", "axes swapped", put.swapped((1, 2, 0)), "refused", "mounting", (3,)),
    Row("IMU", "accelerometer in g", put.in_g, "reported", "imu-gravity", (3,)),
    Row("IMU", "stuck for 5 s", put.frozen, "reported", "imu-stuck", (3,)),
    Row("IMU", "gap of 5 s", put.gap("imu", 5.0), "reported", "motion-gap", (3,)),
    Row("IMU", "gap of 10 s", put.gap("imu", 10.0), "reported", "motion-gap", (3,)),
    Row("IMU", "gap of 30 s", put.gap("imu", 30.0), "refused", "frontend.steps.longest_record", (3,)),
    Row("IMU", "stamps 0.5 s late", put.late("imu", 0.5), "reported", "clocks-disagree", (3,)),
    Row("IMU", "asked for and not in the log", put.clean, "refused", "imu.use names no IMU", (2,),
        {"imu": {"use": "imu"}}),
    Row("log", "no record", put.first(0), "refused", ""),
    Row("log", "one record of each stream", put.first(1), "refused", ""),
    Row("log", "a stream asked for that is not there", put.clean, "refused", "no stream 'radar'", (2, 3),
        {"frontend": {"steps": {"scanners": ["radar"]}}}),
    Row("filter", "one particle", put.clean, "handled", "", (2, 3), {"frontend": {"filter": {"particles": 1}}}),
)  # fmt: skip
FRONT_ENDS = ("rbpf-grid", "segslam")
