"""Faults put into a log of wheels, sightings of landmarks and GPS: each a function from a log to a log.

No log that comes out has truth: the run that is given it must judge itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from graphslam.core.geometry import Array, rotation2, wrap_angle
from graphslam.core.log import SensorLog
from graphslam.core.records import Gps, LandmarkObservations, SteeringControls

Inject = Callable[[SensorLog], SensorLog]


def with_stream(log: SensorLog, name: str, stream: Any) -> SensorLog:
    """The log with one stream in place of the one of that name, without truth."""
    return replace(log, streams={**log.streams, name: stream}, truth=None)


def clean(log: SensorLog) -> SensorLog:
    """No fault: only the truth is taken away."""
    return replace(log, truth=None)


# ---- wheels ----------------------------------------------------------------------------------------------------------


def speed(factor: float) -> Inject:
    """Every speed times a factor."""

    def inject(log: SensorLog) -> SensorLog:
        c: SteeringControls = log["controls"]
        return with_stream(log, "controls", replace(c, speed=factor * c.speed))

    return inject


def steering(factor: float) -> Inject:
    """Every steering angle times a factor: -1 is the other side, 180/π is degrees."""

    def inject(log: SensorLog) -> SensorLog:
        c: SteeringControls = log["controls"]
        return with_stream(log, "controls", replace(c, steering=factor * c.steering))

    return inject


def gap(seconds: float, at: float = 20.0) -> Inject:
    """No record of the wheels for some seconds."""

    def inject(log: SensorLog) -> SensorLog:
        c: SteeringControls = log["controls"]
        keep = (c.times < at) | (c.times >= at + seconds)
        return with_stream(log, "controls", c.take(keep))

    return inject


def gap_of_all(seconds: float, at: float = 20.0) -> Inject:
    """No record of any sensor for some seconds, as where a recorder stops."""

    def inject(log: SensorLog) -> SensorLog:
        streams = {k: s.take((s.times < at) | (s.times >= at + seconds)) for k, s in log.streams.items()}
        return replace(log, streams=streams, truth=None)

    return inject


# ---- sightings -------------------------------------------------------------------------------------------------------


def sightings(change: Callable[[LandmarkObservations, np.random.Generator], LandmarkObservations]) -> Inject:
    """A change of the stream of sightings."""

    def inject(log: SensorLog) -> SensorLog:
        return with_stream(log, "landmarks", change(log["landmarks"], np.random.default_rng(7)))

    return inject


def ranges(factor: float = 1.0, offset: float = 0.0) -> Inject:
    """Ranges in another unit, or longer by a constant; the sensor's stated reach is in the same wrong unit."""
    return sightings(
        lambda z, _: replace(z, ranges=factor * z.ranges + offset, max_range=factor * z.max_range + offset)
    )


def constant_ranges(value: float) -> Inject:
    """A rangefinder that always says the same."""
    return sightings(lambda z, _: replace(z, ranges=np.full_like(z.ranges, value)))


def mirrored() -> Inject:
    """Bearings positive to the right."""
    return sightings(lambda z, _: replace(z, bearings=-z.bearings))


def bearing_offset(angle: float) -> Inject:
    """Bearings from another zero, or the sensor turned on the robot."""

    def change(z: LandmarkObservations, _: np.random.Generator) -> LandmarkObservations:
        low, high = z.field_of_view
        return replace(z, bearings=wrap_angle(z.bearings + angle), field_of_view=(low + angle, high + angle))

    return sightings(change)


def bearings_in_degrees() -> Inject:
    """Numbers of degrees, read as radians; σ and field of view stay as the data sheet says."""
    return sightings(lambda z, _: replace(z, bearings=np.rad2deg(z.bearings)))


def mounted(x: float, y: float, angle: float) -> Inject:
    """The sensor is elsewhere on the robot than the log says."""

    def change(z: LandmarkObservations, _: np.random.Generator) -> LandmarkObservations:
        d = z.ranges[:, None] * np.column_stack([np.cos(z.bearings), np.sin(z.bearings)]) - [x, y]
        d = d @ rotation2(np.array([angle]))[0]
        r, b = np.hypot(d[:, 0], d[:, 1]), np.arctan2(d[:, 1], d[:, 0])
        return replace(z, ranges=r, bearings=b, field_of_view=(-np.pi, np.pi))

    return sightings(change)


def wrong_identities(share: float) -> Inject:
    """Some identities are those of other landmarks."""

    def change(z: LandmarkObservations, rng: np.random.Generator) -> LandmarkObservations:
        assert z.ids is not None
        wrong = rng.random(len(z.ids)) < share
        return replace(z, ids=np.where(wrong, rng.choice(np.unique(z.ids[z.ids >= 0]), len(z.ids)), z.ids))

    return sightings(change)


def repeated(times: int) -> Inject:
    """Every scan again and again under new stamps, as from a driver that hands out its last scan."""

    def change(z: LandmarkObservations, _: np.random.Generator) -> LandmarkObservations:
        source = times * (np.arange(len(z.times)) // times)
        rows = np.concatenate([np.arange(z.offsets[k], z.offsets[k + 1]) for k in source])
        assert z.ids is not None
        return replace(
            z,
            offsets=np.concatenate([[0], np.cumsum(np.diff(z.offsets)[source])]),
            ranges=z.ranges[rows],
            bearings=z.bearings[rows],
            sigmas=z.sigmas[rows],
            ids=z.ids[rows],
        )

    return sightings(change)


def thinned(keep: Callable[[LandmarkObservations], Array]) -> Inject:
    """Only some scans."""
    return sightings(lambda z, _: z.take(keep(z)))


# ---- GPS -------------------------------------------------------------------------------------------------------------


def gps(change: Callable[[Gps, np.random.Generator], Gps]) -> Inject:
    """A change of the fixes."""

    def inject(log: SensorLog) -> SensorLog:
        return with_stream(log, "gps", change(log["gps"], np.random.default_rng(11)))

    return inject
