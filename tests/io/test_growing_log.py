"""A log that is being recorded: in whatever portions it came, it is the log that was sent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from graphslam.core.errors import DataError, FormatError, MissingDataError
from graphslam.core.log import SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.records import VelocityControls
from graphslam.io.growing_log import BEAMS, GrowingLog
from graphslam.io.log_digest import log_digest
from graphslam.io.log_kinds import stream_kinds
from tests.frontends.landmarks.test_preparing import in_portions
from tests.io.test_log_store import every_kind


@pytest.fixture(scope="module")
def log() -> SensorLog:
    whole = every_kind(np.random.default_rng(7))
    return replace(whole, streams={n: s for n, s in whole.streams.items() if len(s.times)}, truth=None, meta={})


def test_every_kind_comes_back_bit_for_bit(log: SensorLog, tmp_path: Path) -> None:
    assert len({type(s) for s in log.streams.values()}) >= 10
    for seed in range(3):
        growing = GrowingLog(log.name, tmp_path / str(seed))
        for name, part in in_portions(log, seed, most=3):
            growing.add(name, part)
            assert growing.until(name) == part.times[-1]
        assert {n: growing.count(n) for n in log.streams} == {n: len(s.times) for n, s in log.streams.items()}
        growing.end()
        assert log_digest(growing.log) == {n: d for n, d in log_digest(in_memory(log)).items() if n in log.streams}


def in_memory(log: SensorLog) -> SensorLog:
    kinds = {k.cls: k for k in stream_kinds().values()}
    streams = {n: kinds[type(s)].stream(kinds[type(s)].arrays(s), n) for n, s in log.streams.items()}
    return SensorLog(name=log.name, streams=streams)


def test_parts_are_those_of_the_whole(log: SensorLog, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    growing = GrowingLog(log.name, tmp_path)
    for name, part in in_portions(log, 0, most=3):
        growing.add(name, part)
    for name, stream in log.streams.items():
        n = len(stream.times)
        for _ in range(5):
            a = int(rng.integers(0, n))
            b = int(rng.integers(a + 1, n + 1))
            got, kind = growing.part(name, a, b), next(k for k in stream_kinds().values() if k.cls is type(stream))
            for x, y in zip(kind.arrays(got).values(), kind.arrays(stream.take(slice(a, b))).values(), strict=True):
                np.testing.assert_array_equal(x, y)


def test_single_records_are_joined_to_a_few_portions(tmp_path: Path) -> None:
    growing = GrowingLog("odometry", tmp_path)
    whole = VelocityControls(times=np.arange(300.0), speed=np.arange(300.0), yaw_rate=np.zeros(300))
    for k in range(300):
        growing.add("wheels", whole.take(slice(k, k + 1)))
        held = growing._held["wheels"]
        assert len(held.parts) <= np.log2(k + 1) + 1
        part = growing.part("wheels", max(k - 20, 0), k + 1)
        assert part.speed.tobytes() == whole.speed[max(k - 20, 0) : k + 1].tobytes()
    assert len(growing.part("wheels", 300).times) == 0


def test_only_beams_are_let_go_of_and_asking_for_them_is_an_error(log: SensorLog, tmp_path: Path) -> None:
    growing = GrowingLog(log.name, tmp_path)
    for name, part in in_portions(log, 0, most=1):
        growing.add(name, part)
    for name, stream in log.streams.items():
        n = len(stream.times)
        growing.discard_before(name, n - 1)
        if isinstance(stream, BEAMS):
            assert growing.held_records[name] == 1
            with pytest.raises(DataError, match="already freed"):
                growing.part(name, 0)
        else:
            assert growing.held_records[name] == n
        assert growing.count(name) == n
        assert growing.part(name, n - 1).times[0] == stream.times[-1]


def test_what_does_not_fit_is_refused_and_leaves_the_log_as_it_is(log: SensorLog, tmp_path: Path) -> None:
    name = next(n for n, s in log.streams.items() if isinstance(s, PointClouds))
    clouds, growing = in_memory(log)[name], GrowingLog("growing", tmp_path)
    first, second = clouds.take(slice(0, 1)), clouds.take(slice(1, 2))
    growing.add(name, second)
    growing.add(name, first)  # late, and then late, twice and new in one portion: one is added
    growing.add(name, clouds.take(slice(0, 3)))
    assert growing.count(name) == 2
    assert growing.drops.counts == {f"{name}: records that came late or twice": 3}
    with pytest.raises(DataError, match="T_base_sensor"):
        growing.add(name, replace(clouds.take(slice(3, 4)), T_base_sensor=np.array([0.5, 0, 0, 0, 0, 0, 1])))
    with pytest.raises(DataError, match="another kind"):
        growing.add(name, next(s for s in log.streams.values() if not isinstance(s, PointClouds)))
    with pytest.raises(FormatError):
        growing.add("odd", SimpleNamespace(times=np.zeros(1)))  # type: ignore[arg-type]
    with pytest.raises(MissingDataError):
        growing.part("odd")
    with pytest.raises(DataError, match="has not ended"):
        _ = growing.log
    growing.end()
    assert growing.count(name) == 2
    assert growing.log.dropped == {f"{name}: records that came late or twice": 3}
    np.testing.assert_array_equal(growing.log[name].cloud(0), second.cloud(0))
    with pytest.raises(DataError, match="after the end"):
        growing.add(name, clouds.take(slice(2, 3)))
