"""What two passes say of each other: a room that is where it was, and one that stands beside itself."""

from __future__ import annotations

import numpy as np
import pytest

from graphslam.app.verdict.checks import findings_from_metrics
from graphslam.app.verdict.figures import RunMetrics
from graphslam.core.poses import SE2, SE3
from graphslam.evidence.beams import BeamModel
from graphslam.maps.contradictions import FEW, Contradictions, find_contradictions
from graphslam.maps.pieces import Piece, PieceId, piece_of_grid
from tests.reference.small_maps import room


def passes(dim: int, off: float) -> tuple[dict[PieceId, Piece], dict[PieceId, np.ndarray]]:
    """A room, two places far away, and the room again, ``off`` metres from where it was."""
    group = SE3 if dim == 3 else SE2
    piece = piece_of_grid(room(group.identity, dim=dim, size=0.1 if dim == 2 else 0.2, beams=20_000))
    at = np.tile(group.identity, (4, 1))
    at[:, 0] = [0.0, 40.0, 80.0, off]
    return {(k, 0): piece for k in range(4)}, {(k, 0): T for k, T in enumerate(at)}


@pytest.mark.parametrize("dim", [2, 3])
def test_a_room_that_stands_beside_itself_is_contradicted(dim: int) -> None:
    once = BeamModel(clamp=(0.41, 0.971))  # one beam says all that is to be said of free space
    same = find_contradictions(*passes(dim, 0.1), once)
    assert sorted(map(tuple, same.pairs.tolist())) == [(0, 3), (3, 0)]
    assert same.points > 300
    assert same.share is not None
    assert same.share < 0.01
    assert not len(same.contradicted_submaps)
    moved = find_contradictions(*passes(dim, 1.5), once)
    assert moved.share is not None
    assert moved.share > 0.05
    assert moved.share > 20 * same.share
    assert find_contradictions(*passes(dim, 1.5)).share in (None, 0.0)  # a single beam may be wrong


def test_verdict_says_which_passes_contradict() -> None:
    def line(share: float, doubted: list[list[int]]) -> tuple[str, str]:
        facts = {"pairs": 9, "points": 900, "share": share, "doubted": doubted}
        found = [f for f in findings_from_metrics(RunMetrics({"map_passes": facts}, {})) if f.code == "passes"]
        return found[0].level, found[0].text

    assert line(0.001, [])[0] == "good"
    assert line(0.02, [[1, 5], [5, 1]])[0] == "look"
    level, text = line(0.2, [[2, 7]])
    assert level == "bad"
    assert "submaps 2 and 7" in text
    assert not [f for f in findings_from_metrics(RunMetrics({}, {})) if f.code == "passes"]


def test_of_a_few_points_nothing_is_reported() -> None:
    few = Contradictions(np.array([[0, 3], [3, 0]]), np.array([FEW - 2, 0]), np.array([0, 1]))
    assert few.share is None
    assert not [f for f in findings_from_metrics(RunMetrics({"map_passes": few.facts()}, {})) if f.code == "passes"]
    enough = Contradictions(few.pairs, np.array([FEW, 0]), np.array([0, 0]))
    assert [
        f.level for f in findings_from_metrics(RunMetrics({"map_passes": enough.facts()}, {})) if f.code == "passes"
    ] == ["good"]
