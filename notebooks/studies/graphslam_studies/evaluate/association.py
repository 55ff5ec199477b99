"""False data associations of a run, by the identities of a simulator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.evaluate.association import Ints, paired_labels


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
    a, b = paired_labels(labels, truth)
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
    detections : int
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

    detections: int
    wrong: int
    landmarks: int
    spurious: int
    duplicated: int
    missed: int

    @property
    def wrong_share(self) -> float:
        """``wrong / detections``."""
        return self.wrong / self.detections if self.detections else float("nan")

    def __add__(self, other: AssociationErrors) -> AssociationErrors:
        """Counts of two maps together."""
        return AssociationErrors(*(getattr(self, f) + getattr(other, f) for f in self.__slots__))


def association_errors(labels: npt.ArrayLike, truth: npt.ArrayLike, *, min_hits: int = 1) -> AssociationErrors:
    """Judge the association of one map; parameters as in :func:`majority_identity`.

    ``labels`` and ``truth`` hold all observations the map was built from, also those it did not use.
    """
    a, b = paired_labels(labels, truth)
    landmarks, identities = majority_identity(a, b)
    used = np.flatnonzero(a >= 0)
    of = identities[np.searchsorted(landmarks, a[used])]
    real = identities[identities >= 0]
    seen, times = np.unique(b[b >= 0], return_counts=True)
    return AssociationErrors(
        detections=len(used),
        wrong=int(np.sum(np.maximum(b[used], -1) != of)),
        landmarks=len(landmarks),
        spurious=int(np.sum(identities < 0)),
        duplicated=len(real) - len(np.unique(real)),
        missed=int(np.sum((times >= min_hits) & ~np.isin(seen, real))),
    )
