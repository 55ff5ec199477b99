"""Rows of the fault matrix: landmark front ends in the plane, and GPS in any run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from graphslam.core.log import SensorLog
from graphslam.core.records import LandmarkObservations
from graphslam_studies.faults import landmarks as inject

Outcome = Literal["refused", "dropped and counted", "handled", "reported"]
KNOWN: Mapping[str, Any] = {"frontend": {"association": "known"}}
LIKELIHOOD: Mapping[str, Any] = {
    "frontend": {"association": "likelihood"},
    "backend": {"associate": True, "merge_every": 4},
}
NEAREST: Mapping[str, Any] = {"frontend": {"association": "nearest"}}


@dataclass(frozen=True)
class Row:
    """One row: sensor × fault × front end → outcome.

    Parameters
    ----------
    sensor, fault : str
    inject : callable
    outcome : str
    shows : str
        Code of a line of the verdict, or a part of the message where the run is refused.
    frontend : str
    log : {"field", "velocities", "increments", "beacons", "gps"}
        Which clean log the fault goes into.
    config : mapping
    dim : int
    """

    sensor: str
    fault: str
    inject: inject.Inject
    outcome: Outcome
    shows: str
    frontend: str = "rbpf-ekf"
    log: str = "field"
    config: Mapping[str, Any] = field(default_factory=lambda: KNOWN)
    dim: int = 2

    @property
    def name(self) -> str:
        """Of the front end, with what it is given."""
        what = {"beacons": ", ranges only", "velocities": ", speed and yaw rate", "increments": ", odometry"}
        how = ", by likelihood" if self.config in (LIKELIHOOD, NEAREST) else ""
        return f"{self.frontend}{what.get(self.log, '')}{how}"

    @property
    def id(self) -> str:
        """Of the test."""
        return f"{self.name}: {self.sensor}: {self.fault}"

    def cells(self) -> tuple[str, ...]:
        """Of the table in ``docs/notes/faults.md``."""
        shows = f"`{self.shows}`" if self.outcome != "refused" else f"“{self.shows}”"
        return self.sensor, self.fault, self.name, f"{self.dim}-D", self.outcome, shows if self.shows else "—"


def _no_observation(z: LandmarkObservations, _: Any) -> LandmarkObservations:
    keep = np.zeros(len(z.ranges), dtype=bool)
    return replace(
        z,
        offsets=np.zeros(len(z.times) + 1, dtype=np.int64),
        ranges=z.ranges[keep],
        bearings=z.bearings[keep],
        sigmas=z.sigmas[keep],
        ids=None if z.ids is None else z.ids[keep],
    )


def _nan(z: LandmarkObservations, _: Any) -> LandmarkObservations:
    return replace(z, ranges=np.full_like(z.ranges, np.nan))


def _twice(z: LandmarkObservations, _: Any) -> LandmarkObservations:
    return replace(z, times=np.repeat(z.times[::2], 2)[: len(z.times)])


def _shifted(seconds: float) -> Any:
    return lambda z, _: replace(z, times=z.times + seconds)


def _records(n: int, name: str) -> inject.Inject:
    def change(log: SensorLog) -> SensorLog:
        return inject.with_stream(log, name, log[name].take(slice(0, n)))

    return change


WHEELS: list[tuple[str, inject.Inject]] = [
    ("speed × 2", inject.speed(2.0)),
    ("speed 0", inject.speed(0.0)),
    ("speed × −1", inject.speed(-1.0)),
    ("speed in km/h (× 3.6)", inject.speed(3.6)),
    ("speed × 1.05", inject.speed(1.05)),
    ("steering to the other side", inject.steering(-1.0)),
    ("steering in degrees", inject.steering(180.0 / np.pi)),
]
OBSERVATIONS: list[tuple[str, inject.Inject]] = [
    ("bearings mirrored", inject.mirrored()),
    ("bearings off by 10°", inject.bearing_offset(np.deg2rad(10.0))),
    ("bearings in degrees", inject.bearings_in_degrees()),
    ("ranges × 2", inject.ranges(2.0)),
    ("ranges × 1.05", inject.ranges(1.05)),
    ("ranges constant", inject.constant_ranges(7.0)),
    ("ranges off by 1 m", inject.ranges(1.0, 1.0)),
    ("sensor 1 m to the side", inject.mounted(0.0, 1.0, 0.0)),
    ("sensor 1 m to the side, turned by 10°", inject.mounted(0.0, 1.0, np.deg2rad(10.0))),
]
GAPS: list[tuple[str, inject.Inject]] = [
    ("5 s without wheels", inject.gap(5.0)),
    ("10 s without wheels", inject.gap(10.0)),
    ("30 s without wheels", inject.gap(30.0)),
    ("10 s without any sensor", inject.gap_of_all(10.0)),
    ("30 s without any sensor", inject.gap_of_all(30.0)),
]


RATES: list[tuple[str, inject.Inject]] = [
    ("speed × 2", inject.rates(speed=2.0)),
    ("yaw rate in degrees per second", inject.rates(yaw_rate=180.0 / np.pi)),
    ("yaw rate of the wrong sign", inject.rates(yaw_rate=-1.0)),
    ("yaw rate off by 1 °/s", inject.rates(bias=float(np.deg2rad(1.0)))),
]
UNKNOWN = "leave its heading unknown within one record"
ODOMETRY: list[tuple[str, inject.Inject, Outcome, str]] = [
    ("increments × 2", inject.increments(2.0), "reported", "calibration|residuals"),
    ("increments 0", inject.increments(0.0), "reported", "calibration|residuals"),
    ("increments × −1", inject.increments(-1.0), "reported", "calibration|residuals"),
    ("10 s without records", inject.odometry_gap(10.0), "handled", "motion-gap"),
    ("covariance 1e−12 of the stated one", inject.stated_covariance(1e-12), "reported", "residuals"),
    ("covariance 1e12 times the stated one", inject.stated_covariance(1e12), "refused", UNKNOWN),
]
MILLIMETRES = ("ranges × 1000", inject.ranges(1000.0))
KILOMETRES = ("ranges × 0.001", inject.ranges(0.001))
HARDLY = "ranges hardly change while the robot drives"
OF_FIXES = "chi2|consistency-test|gps-correlated|gps-errors"
GPS: list[tuple[str, inject.Inject, Outcome, str]] = [
    ("another time base", inject.gps(lambda g, _: replace(g, times=g.times + 1e6)), "reported", "gps-not-used"),
    (
        "stuck",
        inject.gps(lambda g, _: replace(g, positions=np.tile(g.positions[0], (len(g.times), 1)))),
        "reported",
        "gps-stuck",
    ),
    ("degrees of longitude and latitude", inject.gps(inject.degrees), "reported", "gps-scale"),
    (
        "axes swapped",
        inject.gps(inject.axes_swapped),
        "reported",
        "gps-mirrored",
    ),
    ("bursts of outliers", inject.gps(inject.bursts), "reported", OF_FIXES),
    ("slow ramp", inject.gps(inject.ramp), "reported", OF_FIXES),
    ("lag of 1 s", inject.gps(lambda g, _: replace(g, times=g.times + 1.0)), "reported", OF_FIXES),
    ("error constant for 60 s, σ of the noise alone", inject.gps(inject.correlated(0.3)), "reported", OF_FIXES),
    ("error constant for 60 s, σ of all of it", inject.gps(inject.correlated(3.0)), "reported", "gps-correlated"),
    ("only at the start", inject.gps(lambda g, _: g.take(g.times < 5.0)), "reported", "gps-not-used"),
    (
        "off by 1 km, constantly",
        inject.gps(inject.off_by_1_km),
        "handled",
        "",
    ),
    ("no fix at all", inject.gps(lambda g, _: g.take(slice(0, 0))), "reported", "gps-empty"),
]
FIT = "calibration|residuals|observations-not-used"


def _rows() -> list[Row]:
    rows: list[Row] = []
    for frontend in ("rbpf-ekf", "ekf-slam", "rbpf-slam"):
        rows += [Row("wheels", f, i, "reported", "calibration|residuals", frontend) for f, i in WHEELS]
        rows += [Row("landmarks", f, i, "reported", "calibration|residuals", frontend) for f, i in OBSERVATIONS]
        rows.append(Row("landmarks", *MILLIMETRES, "reported", "observations-not-used", frontend))
        rows.append(Row("landmarks", *KILOMETRES, "refused", HARDLY, frontend))
        ids = inject.wrong_identities(0.1)
        rows += [Row("landmarks", "10 % wrong identities", ids, "reported", "residuals", frontend)]
        rows += [
            Row(
                "landmarks",
                "none in any scan",
                inject.detections(_no_observation),
                "reported",
                "observations-not-used",
                frontend,
            )
        ]
    for f, i in GAPS:
        rows += [Row("wheels", f, i, "handled", "motion-gap"), Row("wheels", f, i, "handled", "motion-gap", "ekf")]
        single: Outcome = "reported" if "any sensor" in f else "handled"
        rows.append(Row("wheels", f, i, single, "motion-gap", "ekf-slam"))
    short = {"frontend": {"association": "known", "longest_gap": 8.0}}
    for frontend in ("rbpf-ekf", "ekf-slam", "rbpf-slam"):
        beyond = Row(
            "wheels", "a gap longer than may be bridged", inject.gap(10.0), "refused", "frontend.longest_gap", frontend
        )
        rows.append(replace(beyond, config=short))
    for frontend, config in (("rbpf-ekf", LIKELIHOOD), ("ekf-slam", NEAREST)):
        rows += [Row("wheels", f, i, "reported", FIT, frontend, config=config) for f, i in WHEELS]
        faults = [*OBSERVATIONS, MILLIMETRES]
        rows += [Row("landmarks", f, i, "reported", FIT, frontend, config=config) for f, i in faults]
    # by ranges alone, wheels that turn the other way give the mirror image of everything: a limit, not a row
    blind = [
        *(x for x in WHEELS if "other side" not in x[0]),
        *(x for x in [*OBSERVATIONS, MILLIMETRES] if x[0].startswith("ranges")),
    ]
    rows += [Row("beacons", f, i, "reported", FIT, log="beacons") for f, i in blind]
    rows.append(Row("beacons", *KILOMETRES, "refused", HARDLY, log="beacons"))
    rows += [Row("beacons", "10 % wrong identities", inject.wrong_identities(0.1), "reported", FIT, log="beacons")]
    for frontend in ("rbpf-ekf", "ekf-slam", "rbpf-slam"):
        rows += [Row("wheels", f, i, "reported", "calibration|residuals", frontend, "velocities") for f, i in RATES]
        for f, i, o, s in ODOMETRY:  # one filter over a whole log is overconfident without a gap, too, and says so
            out: Outcome = "reported" if frontend == "rbpf-slam" and o == "handled" else o
            rows.append(Row("odometry", f, i, out, s, frontend, "increments"))
        rows.append(Row("IMU", "level, in the plane", inject.with_imu, "handled", "", frontend))
        rows[-1] = replace(rows[-1], config={**KNOWN, "imu": {"use": "imu"}})
    rows.append(Row("wheels", "10 s without wheels", inject.gap(10.0), "handled", "motion-gap", log="velocities"))
    used = {"gps": {"use": "all"}}
    rows += [Row("GPS", f, i, o, s, log="gps", config=used) for f, i, o, s in GPS]
    half = {"gps": {"use": "every-second"}}
    rows += [
        Row(
            "GPS",
            f"{GPS[8][0]}, half of the fixes withheld",
            GPS[8][1],
            "reported",
            "gps-correlated",
            log="gps",
            config=half,
        )
    ]
    for frontend in ("ekf-slam", "rbpf-slam"):
        rows += [Row("GPS", f, i, o, s, frontend, log="gps", config=used) for f, i, o, s in (GPS[0], GPS[1], GPS[3])]
    for name, seconds in (("stamps 1 s late", 1.0), ("stamps 1 s early", -1.0)):
        rows.append(Row("landmarks", name, inject.detections(_shifted(seconds)), "reported", "residuals"))
    rows += [
        Row("landmarks", "every scan ten times", inject.repeated(10), "reported", FIT),
        Row("landmarks", "every scan ten times", inject.repeated(10), "reported", FIT, "ekf-slam"),
        Row("landmarks", "all ranges NaN", inject.detections(_nan), "refused", "is not finite"),
        Row("landmarks", "stamps that repeat", inject.detections(_twice), "refused", "time does not increase"),
        Row("landmarks", "log without a record", _records(0, "landmarks"), "refused", "no scan to work on"),
        Row("landmarks", "log of one scan", _records(1, "landmarks"), "handled", ""),
        Row("wheels", "log without a record", _records(0, "controls"), "refused", "motion stream is empty"),
        Row("wheels", "log of one record", _records(1, "controls"), "refused", "a single record"),
        Row(
            "settings",
            "one particle",
            inject.clean,
            "reported",
            "particles",
            config={**LIKELIHOOD, "frontend": {"association": "likelihood", "particles": 1}},
        ),
        Row(
            "settings",
            "assumed noise of the observations four times too small",
            inject.clean,
            "reported",
            "residuals",
            config={"frontend": {"noise": {"range_sigma": 0.05, "bearing_sigma": 0.009}}},
        ),
    ]
    return rows


ROWS: list[Row] = _rows()


def table() -> str:
    """The rows as ``docs/notes/faults.md`` shows them: front ends with the same outcome share a line."""
    seen: dict[tuple[str, ...], list[str]] = {}
    for row in ROWS:
        sensor, fault, name, dim, outcome, shows = row.cells()
        seen.setdefault((sensor, fault, dim, outcome, shows), []).append(name)
    lines = ["| Sensor | Fault | Front end | World | Outcome | A user sees |", "|---|---|---|---|---|---|"]
    for (sensor, fault, dim, outcome, shows), names in seen.items():
        front = "; ".join(dict.fromkeys(names))
        lines.append(f"| {sensor} | {fault} | {front} | {dim} | {outcome} | {shows.replace('|', '` or `')} |")
    return "\n".join(lines)
