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
        Our landmarks with observations of more than one reference landmark.
    split : int
        Reference landmarks whose observations are split over several of ours.
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
    a, b = paired_labels(labels, reference)
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


def paired_labels(labels: npt.ArrayLike, reference: npt.ArrayLike) -> tuple[Ints, Ints]:
    a, b = np.asarray(labels, dtype=np.int64), np.asarray(reference, dtype=np.int64)
    if a.shape != b.shape or a.ndim != 1:
        raise DataError("labellings differ in shape", got=a.shape, wanted=b.shape)
    return a, b
