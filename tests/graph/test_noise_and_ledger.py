"""Covariances before GTSAM sees them, robust kernels against GTSAM's own, and the ledger's refusals."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from graphslam.core.errors import ConfigError, CovarianceError, DataError, EvidenceReusedError
from graphslam.graph.ledger import EXCLUSIVE, EvidenceUse, Ledger
from graphslam.graph.noise import RobustKernel, whitener
from tests.reference.graph_chain import correlated_covariance


def test_whitener_whitens_and_scales(rng):
    P = correlated_covariance(rng, 5, 0.3)
    W = whitener(P, scale=4.0)
    np.testing.assert_allclose(W @ (4.0 * P) @ W.T, np.eye(5), atol=1e-12)


@pytest.mark.parametrize(
    ("bad", "word"),
    [
        (np.zeros((2, 2)), "positive definite"),
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), "finite"),
        (np.array([[1.0, 0.5], [0.0, 1.0]]), "symmetric"),
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "positive definite"),
        (np.eye(3), "shape"),
    ],
)
def test_bad_covariances_are_named(bad, word):
    with pytest.raises(CovarianceError, match=word):
        whitener(bad, what="thing", dim=2)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_bad_scale_is_refused(scale):
    with pytest.raises(CovarianceError, match="scale"):
        whitener(np.eye(2), scale=scale)


@pytest.mark.parametrize("kind", ["huber", "cauchy"])
@pytest.mark.parametrize("k", [0.7, 1.345, 3.0])
def test_kernels_are_gtsams(kind, k):
    theirs = getattr(gtsam.noiseModel.mEstimator, kind.capitalize()).Create(k)
    ours = RobustKernel(kind, k)
    for d in (0.0, 0.3, 0.7, 1.345, 2.0, 10.0, 1e3):
        assert ours.loss(np.array([d * d]))[0] == pytest.approx(2 * theirs.loss(d), rel=1e-12, abs=1e-300)
        assert ours.weight(np.array([d * d]))[0] == pytest.approx(theirs.weight(d), rel=1e-12)


def test_unknown_kernels_are_refused():
    with pytest.raises(ConfigError, match="known"):
        RobustKernel("tukey", 1.0)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="positive"):
        RobustKernel("huber", 0.0)


# ------------------------------------------------------------------ ledger


@pytest.fixture
def ledger() -> Ledger:
    book = Ledger()
    book.spend(0, "submap 0", {"laser", "odometry"}, (0.0, 10.0))
    book.spend(1, "submap 1", {"laser", "odometry"}, (10.0, 20.0))
    return book


@pytest.mark.parametrize("interval", [(9.0, 11.0), (2.0, 3.0), (0.0, 10.0), (-5.0, 0.1), (5.0, 5.0), (10.0, 10.0)])
def test_overlap_is_refused_and_changes_nothing(ledger, interval):
    before = ledger.entries()
    with pytest.raises(EvidenceReusedError, match=r"'odometry'.*second time"):
        ledger.spend(2, "between x0 x1", ["gyro", "odometry"], interval)
    assert ledger.entries() == before


@pytest.mark.parametrize("interval", [(20.0, 30.0), (-1.0, 0.0), (20.0, 20.0), (-3.0, -3.0)])
def test_touching_intervals_are_not_overlapping(ledger, interval):
    ledger.spend(2, "more", ["odometry"], interval)
    assert len(ledger) == 5


def test_other_streams_and_declared_kinds_pass(ledger):
    ledger.spend(2, "gps", ["gps"], (5.0, 5.0))
    ledger.spend(3, "match", ["laser"], (0.0, 10.0), kind="shared-scan")
    ledger.declare("calibration", "used to calibrate, variance inflated")
    ledger.spend(4, "calibration", ["odometry"], (0.0, 20.0), kind="calibration")
    with pytest.raises(ConfigError, match="not declared"):
        ledger.spend(5, "sneaky", ["laser"], (0.0, 10.0), kind="whatever")
    with pytest.raises(ConfigError, match="reason"):
        ledger.declare("because", " ")
    table = ledger.table()
    assert list(table.columns) == ["factor_id", "factor", "stream", "t_start", "t_end", "kind", "note"]
    assert len(table) == 7
    assert "registers" in table[table.kind == "shared-scan"].note.iloc[0]


def test_refund_makes_room_for_the_same_evidence_only(ledger):
    ledger.release(0)
    ledger.spend(2, "again", ["laser"], (0.0, 10.0))
    with pytest.raises(EvidenceReusedError):
        ledger.spend(3, "again", ["laser"], (15.0, 16.0))


def test_refund_of_a_declared_factor_frees_nobody_elses_evidence(ledger):
    """A scan match over the interval of a submap: removing the match must not make the submap's scans free again."""
    ledger.spend(-1, "match before", ["laser"], (0.0, 10.0), kind="shared-scan")
    ledger.spend(7, "match after", ["laser"], (15.0, 20.0), kind="shared-scan")
    ledger.release(-1)
    ledger.release(7)
    assert [e.factor for e in ledger.entries() if e.stream == "laser"] == ["submap 0", "submap 1"]
    for interval in ((0.0, 10.0), (10.0, 20.0)):
        with pytest.raises(EvidenceReusedError):
            ledger.spend(8, "again", ["laser"], interval)
    ledger.release(99)  # never entered
    assert len(ledger) == 4


def test_a_stream_named_twice_is_spent_once_and_refusals_name_the_first_stream(ledger):
    streams = [f"beacon {c}" for c in "hgfedcbaijkl"]
    ledger.spend(2, "beacons", [*streams, *streams], (0.0, 1.0))
    assert len(ledger) == 4 + len(streams)
    # whatever the order in which they are given: the same words at every run
    with pytest.raises(EvidenceReusedError, match="'beacon a'"):
        ledger.spend(3, "again", streams, (0.5, 2.0))


@pytest.mark.parametrize("interval", [(1.0, 0.0), (np.nan, 1.0), (0.0, np.inf)])
def test_impossible_intervals(ledger, interval):
    with pytest.raises(DataError, match="interval"):
        ledger.spend(9, "bad", ["x"], interval)


def test_against_brute_force(rng):
    """Random spendings: accepted exactly when no accepted one overlaps."""
    book, accepted = Ledger(), []
    for k in range(400):
        a = round(float(rng.uniform(0, 200)), 1)
        b = a + round(float(rng.choice([0.0, 0.1, 0.7, 3.0])), 1)

        def inside(t, c, d):
            return c <= t < d or (c == d == t)

        clash = any((max(a, c) < min(b, d)) or inside(a, c, d) or inside(c, a, b) for c, d in accepted)
        try:
            book.spend(k, f"f{k}", ["s"], (a, b))
            assert not clash
            accepted.append((a, b))
        except EvidenceReusedError:
            assert clash
    assert 20 < len(accepted) < 380


def test_what_was_only_a_start_leaves_its_streams_to_be_spent() -> None:
    ledger = Ledger()
    ledger.spend(0, "submap 0", ["laser", "wheels"], (0.0, 10.0))
    ledger.spend(3, "match", ["laser"], (0.0, 10.0), kind="shared-scan")
    start = ledger.as_start()
    assert [(e.factor_id, e.stream, e.t_start, e.t_end) for e in start.entries()] == [
        (e.factor_id, e.stream, e.t_start, e.t_end) for e in ledger.entries()
    ]
    assert {e.kind for e in start.entries()} == {"start"}
    start.spend(-1, "scan-pairs", ["laser", "wheels"], (0.0, 10.0))
    with pytest.raises(EvidenceReusedError, match="scan-pairs used it"):
        start.spend(4, "late", ["laser"], (9.0, 11.0))
    assert ledger.conflict("laser", (5.0, 6.0)).factor == "submap 0"  # the first ledger is as it was


def test_a_declared_kind_is_entered_without_streams_and_a_measurement_is_not(ledger) -> None:
    ledger.declare("calibration", "used to calibrate, variance inflated")
    assert ledger.enter(7, "range x0 x1", "calibration") == "calibration"
    (e,) = [e for e in ledger.entries() if e.factor_id == 7]
    assert (e.stream, e.t_start, e.t_end, e.kind) == ("-", 0.0, 0.0, "calibration")
    with pytest.raises(ConfigError, match="range x0 x2 must name the streams"):
        ledger.enter(8, "range x0 x2", EXCLUSIVE)
    assert ledger.enter(9, "range x0 x3", EvidenceUse(["radio"], (50.0, 51.0))) == EXCLUSIVE
