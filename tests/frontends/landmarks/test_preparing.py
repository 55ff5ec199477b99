"""A log made ready while its records come is the log made ready at once, bit for bit, whatever the portions."""

from __future__ import annotations

import heapq
import tempfile
from collections.abc import Iterator
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import graphslam as gs
from graphslam.core.errors import MissingDataError
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.records import LandmarkObservations, Odometry, VelocityControls
from graphslam.io.growing_log import GrowingLog
from graphslam_frontends.landmarks.config import RangeBearingNoise, RbpfEkfConfig
from graphslam_frontends.landmarks.prepare import LogPreparation, PreparedLog, prepare_log
from graphslam_frontends.odometry.motion import MotionNoise, dead_reckoned_increments


def in_portions(log: SensorLog, seed: int, most: int = 7) -> Iterator[tuple[str, Any]]:
    """Records of all streams in the order of their stamps, as a robot sends them: now and then several at once."""
    rng = np.random.default_rng(seed)
    next_of = dict.fromkeys(log.streams, 0)
    queue = [(float(s.times[0]), name) for name, s in log.streams.items()]
    heapq.heapify(queue)
    while queue:
        _, name = heapq.heappop(queue)
        a = next_of[name]
        b = next_of[name] = min(a + int(rng.integers(1, most + 1)), len(log[name].times))
        yield name, log[name].take(slice(a, b))
        if b < len(log[name].times):
            heapq.heappush(queue, (float(log[name].times[b]), name))


def steering() -> SensorLog:
    return gs.simulate("landmark-field", preset="quick", seed=3)


def velocities(cut: bool = True) -> SensorLog:
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 60.0, 0.1)
    motion = VelocityControls(times=t, speed=rng.uniform(0.2, 1.0, len(t)), yaw_rate=rng.normal(0.0, 0.2, len(t)))
    if cut:  # two gaps, and the last control is held for three seconds
        motion = motion.take((t < 20.0) | ((t > 24.0) & (t < 25.5)) | ((t > 31.0) & (t < 57.0)))
    n = 151
    times = np.sort(np.concatenate([np.arange(-0.3, 59.7, 0.4), [20.0]]))[:n]
    sizes = rng.integers(0, 4, n)
    q = int(sizes.sum())
    bearing = rng.uniform(0.5, 3.0, q)
    detections = LandmarkObservations(
        times=times,
        offsets=np.concatenate([[0], np.cumsum(sizes)]),
        ranges=np.where(rng.random(q) < 0.05, 0.0, rng.uniform(1.0, 60.0, q)),
        bearings=bearing - 1.5,
        sigmas=np.column_stack([rng.uniform(0.05, 0.2, q), rng.uniform(0.01, 0.05, q)]),
        ids=rng.integers(-1, 6, q),
    )
    return SensorLog(name="drawn", streams={"wheels": motion, "seen": detections})


def recorded() -> SensorLog:
    log = velocities(cut=False)
    stamps = log["wheels"].times[::3]
    odometry, _ = dead_reckoned_increments(log, stamps, MotionNoise(speed=0.02, yaw_rate=0.01))
    kept = (stamps < 20.0) | (stamps > 27.0)
    return SensorLog(name="odometry", streams={"odometry": odometry.take(kept), "seen": log["seen"]})


def slow() -> SensorLog:
    """Odometry at 0.4 Hz: every pause is longer than one of a robot that has stopped, and none is a gap."""
    log = velocities(cut=False)
    odometry, _ = dead_reckoned_increments(log, log["wheels"].times[::25], MotionNoise(speed=0.02, yaw_rate=0.01))
    return SensorLog(name="slow", streams={"odometry": odometry, "seen": log["seen"]})


def differing(a: Any, b: Any, where: str = "") -> list[str]:
    out = []
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, LandmarkObservations | Odometry):
            out += differing(x, y, f"{where}{f.name}.")
        elif isinstance(x, np.ndarray):
            out += [] if x.dtype == y.dtype and x.tobytes() == y.tobytes() else [where + f.name]
        else:
            out += [] if x == y else [where + f.name]
    return out


@pytest.mark.parametrize("make", [steering, velocities, recorded, slow])
@pytest.mark.parametrize("known", [False, True])
def test_portions_change_nothing(make: Any, known: bool) -> None:
    log = make()
    noise = RangeBearingNoise(range_sigma=0.1, bearing_sigma=0.02, range_scale=1.02) if known else None
    config = RbpfEkfConfig(association="known" if known else "likelihood", max_range=30.0, noise=noise)
    counts = DropCounter()
    whole = prepare_log(log, config, counts)
    assert len(whole.gaps) == {"drawn": 3, "odometry": 1}.get(log.name, 0)
    for seed, most in ((0, 1), (1, 40), (2, 400)):
        drops = DropCounter()
        with tempfile.TemporaryDirectory() as folder:
            growing = GrowingLog(log.name, folder)
            made = LogPreparation(growing, config, drops)
            steps = 0
            for name, part in in_portions(log, seed, most):
                growing.add(name, part)
                while made.advance():
                    steps += 1
            held = 0 if made.made is None else len(made.made)
            growing.end()
            assert made.advance()
            assert not made.advance()
        assert differing(made.prepared, whole) == []
        assert drops.counts == counts.counts
        assert steps > 3 or most > 100
        assert 0.75 * len(whole) < held <= len(whole)


def test_a_scan_is_there_when_it_is_known_to_be_the_last_or_not() -> None:
    log = steering()
    with tempfile.TemporaryDirectory() as folder:
        growing = GrowingLog(log.name, folder)
        made = LogPreparation(growing, RbpfEkfConfig(), DropCounter())
        waiting = made.reach(2)
        assert next(waiting, "there") is None
        growing.add("landmarks", log["landmarks"].take(slice(0, 3)))
        growing.add("controls", log["controls"])
        assert next(waiting, "there") is None  # the fourth is wanted
        growing.add("landmarks", log["landmarks"].take(slice(3, 4)))
        assert next(waiting, "there") == "there"
        waiting = made.reach(3)
        assert next(waiting, "there") is None
        growing.end()
        with pytest.raises(StopIteration) as end:
            next(waiting)
        assert end.value.value is True
        with pytest.raises(StopIteration) as end:
            next(made.reach(4))
        assert end.value.value is False


def test_a_log_that_ends_without_a_scan_or_motion_is_refused() -> None:
    log = steering()
    for name, wanted in (("controls", "no landmarks"), ("landmarks", "no motion")):
        with tempfile.TemporaryDirectory() as folder:
            growing = GrowingLog(log.name, folder)
            growing.add(name, log[name])
            growing.end()
            with pytest.raises(MissingDataError, match=wanted):
                LogPreparation(growing, RbpfEkfConfig(), DropCounter()).advance()


def test_usual_noise_is_the_mean_of_what_was_seen_until_then() -> None:
    data: PreparedLog = prepare_log(velocities(), RbpfEkfConfig(max_range=30.0), DropCounter())
    for scan in (0, 10, len(data) - 1):
        seen = data.rows[: data.observations.offsets[scan + 1], 2:]
        expected = np.sqrt(seen.mean(axis=0)) if len(seen) else np.ones(2)
        np.testing.assert_allclose(data.usual_sigma(scan), expected[[0, 0, 1]], rtol=1e-12)
