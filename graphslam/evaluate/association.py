"""How well one data association agrees with another, by pairs of observations.

Two observations that we call the same landmark should be the same in the reference (precision); two that are the same
in the reference should be the same in ours (recall). Counting pairs needs no matching of landmark names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import DataError
from graphslam.core.geometry import Array, wrap_angle

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PairAgreement:
    """Agreement of two labellings of the same observations.

    Parameters
    ----------
    observations : int
        Observations labelled by both.
    together, together_reference, together_both : int
        Pairs of observations under one label in ours, in the reference, and in both.
    mixed : int
        Our landmarks that hold observations of more than one reference landmark.
    split : int
        Reference landmarks whose observations lie in more than one of ours.
    """

    observations: int
    together: int
    together_reference: int
    together_both: int
    mixed: int
    split: int

    @property
    def precision(self) -> float:
        """Share of our pairs that the reference confirms."""
        return self.together_both / self.together if self.together else float("nan")

    @property
    def recall(self) -> float:
        """Share of the reference's pairs that we found."""
        return self.together_both / self.together_reference if self.together_reference else float("nan")

    def as_row(self) -> dict[str, Any]:
        """One row of a table."""
        return {
            "observations": self.observations,
            "pair_precision": self.precision,
            "pair_recall": self.recall,
            "mixed": self.mixed,
            "split": self.split,
        }


def pair_agreement(labels: npt.ArrayLike, reference: npt.ArrayLike) -> PairAgreement:
    """Compare labels ``(n,)`` with reference labels ``(n,)``; a negative label means none, such rows are left out."""
    a, b = _labellings(labels, reference)
    both = (a >= 0) & (b >= 0)
    a, b = a[both], b[both]
    cells, counts = np.unique(np.stack([a, b], 1), axis=0, return_counts=True)

    def pairs(n: Ints) -> int:
        return int(np.sum(n * (n - 1) // 2))

    _, per_a = np.unique(a, return_counts=True)
    _, per_b = np.unique(b, return_counts=True)
    return PairAgreement(
        observations=len(a),
        together=pairs(per_a),
        together_reference=pairs(per_b),
        together_both=pairs(counts),
        mixed=int(np.sum(np.unique(cells[:, 0], return_counts=True)[1] > 1)) if len(cells) else 0,
        split=int(np.sum(np.unique(cells[:, 1], return_counts=True)[1] > 1)) if len(cells) else 0,
    )


def majority_identity(labels: npt.ArrayLike, truth: npt.ArrayLike) -> tuple[Ints, Ints]:
    """What every landmark of a map really is: the true identity of most of its observations.

    Parameters
    ----------
    labels : (n,) int
        Landmark that each observation was assigned to; negative = to none.
    truth : (n,) int
        What each observation really saw; negative = nothing (clutter).

    Returns
    -------
    landmarks : (k,)
        The labels in use, ascending.
    identities : (k,)
        Identity of each, -1 where most observations are clutter; of equals the smallest, clutter before any.
    """
    a, b = _labellings(labels, truth)
    used = a >= 0
    cells, counts = np.unique(np.stack([a[used], np.maximum(b[used], -1)], 1), axis=0, return_counts=True)
    order = np.lexsort((cells[:, 1], -counts, cells[:, 0]))
    landmarks, first = np.unique(cells[order, 0], return_index=True)
    return landmarks, cells[order[first], 1]


@dataclass(frozen=True, slots=True)
class AssociationErrors:
    """What went wrong inside one map, judged by the true identities of its observations.

    Parameters
    ----------
    sightings : int
        Observations that were assigned to a landmark.
    wrong : int
        Of these, observations of something else than their landmark is by majority: another feature, clutter in a
        real landmark, or a real feature in a landmark of clutter.
    landmarks : int
        Landmarks of the map.
    spurious : int
        Landmarks that are clutter by majority.
    duplicated : int
        Landmarks that are by majority a feature which another landmark of the map already is.
    missed : int
        Features observed at least ``min_hits`` times that no landmark of the map is by majority.
    """

    sightings: int
    wrong: int
    landmarks: int
    spurious: int
    duplicated: int
    missed: int

    @property
    def wrong_share(self) -> float:
        """``wrong / sightings``."""
        return self.wrong / self.sightings if self.sightings else float("nan")

    def __add__(self, other: AssociationErrors) -> AssociationErrors:
        """Counts of two maps together."""
        return AssociationErrors(*(getattr(self, f) + getattr(other, f) for f in self.__slots__))


def association_errors(labels: npt.ArrayLike, truth: npt.ArrayLike, *, min_hits: int = 1) -> AssociationErrors:
    """Judge the association of one map; parameters as in :func:`majority_identity`.

    ``labels`` and ``truth`` hold all observations the map was built from, also those it did not use.
    """
    a, b = _labellings(labels, truth)
    landmarks, identities = majority_identity(a, b)
    used = np.flatnonzero(a >= 0)
    of = identities[np.searchsorted(landmarks, a[used])]
    real = identities[identities >= 0]
    seen, times = np.unique(b[b >= 0], return_counts=True)
    return AssociationErrors(
        sightings=len(used),
        wrong=int(np.sum(np.maximum(b[used], -1) != of)),
        landmarks=len(landmarks),
        spurious=int(np.sum(identities < 0)),
        duplicated=len(real) - len(np.unique(real)),
        missed=int(np.sum((times >= min_hits) & ~np.isin(seen, real))),
    )


def _labellings(labels: npt.ArrayLike, reference: npt.ArrayLike) -> tuple[Ints, Ints]:
    a, b = np.asarray(labels, dtype=np.int64), np.asarray(reference, dtype=np.int64)
    if a.shape != b.shape or a.ndim != 1:
        raise DataError("labellings differ in shape", got=a.shape, wanted=b.shape)
    return a, b


def match_observations(
    times: Array,
    ranges: Array,
    bearings: Array,
    reference_times: Array,
    reference_ranges: Array,
    reference_bearings: Array,
    *,
    max_range_difference: float = 0.3,
    max_bearing_difference: float = float(np.deg2rad(0.5)),
    max_time_difference: float = 0.005,
) -> Ints:
    """Row of the reference for every observation ``(n,)``, -1 where there is none.

    Both lists are in time order. Within one scan the nearest pairs (each difference divided by its gate) are taken
    first, every row at most once.
    """
    out = np.full(len(times), -1, dtype=np.int64)
    lo = np.searchsorted(reference_times, times - max_time_difference, "left")
    hi = np.searchsorted(reference_times, times + max_time_difference, "right")
    span = hi - lo
    i = np.repeat(np.arange(len(times)), span)
    j = np.arange(span.sum()) - np.repeat(np.cumsum(span) - span, span) + np.repeat(lo, span)
    dr = np.abs(ranges[i] - reference_ranges[j]) / max_range_difference
    db = np.abs(wrap_angle(bearings[i] - reference_bearings[j])) / max_bearing_difference
    ok = (dr <= 1) & (db <= 1)
    i, j, cost = i[ok], j[ok], np.hypot(dr[ok], db[ok])
    taken: set[int] = set()
    for k in np.argsort(cost, kind="stable"):
        a, b = int(i[k]), int(j[k])
        if out[a] < 0 and b not in taken:
            out[a] = b
            taken.add(b)
    return out
