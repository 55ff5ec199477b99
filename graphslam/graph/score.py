"""The objective of a graph, per class of factor: the figures that say whether the noise is believed too much."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from graphslam.core.geometry import Array
from graphslam.core.markup import table
from graphslam.graph.flat import FlatGraph


@dataclass(frozen=True, slots=True)
class ClassScore:
    """``χ²`` of one class of factors.

    Parameters
    ----------
    chi2 : float
        ``Σ rᵀ P⁻¹ r`` (``Σ 2 ρ`` under a robust kernel).
    factors, rows : int
        Factors, and scalars they measure.
    dof : int
        ``rows`` less the unknowns that this class alone brings in: poses and landmarks for submaps, the datum for GPS,
        biases for their priors, the tilt for attitudes, velocities and biases of an IMU for its ways. Summed over the
        classes it is the dof of the whole.
    """

    chi2: float
    factors: int
    rows: int
    dof: int

    @property
    def chi2_per_dof(self) -> float:
        """About 1 where the covariances are honest; ``nan`` without redundancy."""
        return self.chi2 / self.dof if self.dof > 0 else float("nan")


@dataclass(frozen=True, slots=True)
class Score:
    """Objective of a graph at given values; ``score["submap"].chi2_per_dof`` is the *χ²/dof of the join*."""

    classes: dict[str, ClassScore]

    def __getitem__(self, name: str) -> ClassScore:
        return self.classes[name]

    def __contains__(self, name: str) -> bool:
        return name in self.classes

    def __iter__(self) -> Iterator[str]:
        return iter(self.classes)

    @property
    def total(self) -> float:
        """``Σ rᵀ P⁻¹ r`` over all factors (no ½)."""
        return sum(c.chi2 for c in self.classes.values())

    @property
    def dof(self) -> int:
        """Rows less states."""
        return sum(c.dof for c in self.classes.values())

    def _repr_html_(self) -> str:
        rows = [
            {"class": n, "factors": c.factors, "χ²": c.chi2, "dof": c.dof, "χ²/dof": c.chi2_per_dof}
            for n, c in self.classes.items()
        ]
        return table(rows, ["class", "factors", "χ²", "dof", "χ²/dof"])


def score(flat: FlatGraph, chi2: Array) -> Score:
    """Sum ``chi2`` ``(f,)``, in the order of ``flat.records``, by class."""
    lay = flat.layout
    sums: dict[str, list[float]] = {}
    for record, value in zip(flat.records, chi2.tolist()):
        c = sums.setdefault(record.group, [0.0, 0, 0])
        c[0] += value
        c[1] += 1
        c[2] += record.rows
    unknowns = {
        "gps": lay.datum_dof if lay.datum else 0,
        "gps-bias": lay.dim * lay.biases,
        "attitude": 2 if lay.tilt else 0,
        # every record of the class brings in, or ties, one bias; the ways bring in the others and the velocities
        "imu-bias": 6 * int(sums.get("imu-bias", [0.0, 0, 0])[1]),
        "imu": 3 * lay.velocities + 6 * (lay.imu_biases - int(sums.get("imu-bias", [0.0, 0, 0])[1])),
    }
    if lay.tilt and "attitude" not in sums and "levelled" not in sums:
        owner = "imu" if "imu" in sums else "imu-gravity"
        unknowns[owner] = unknowns.get(owner, 0) + 2
    chain = next((g for g in ("submap", "dense-submap") if g in sums), next(iter(sums), ""))
    unknowns[chain] = unknowns.get(chain, 0) + lay.datum_start
    return Score(
        {g: ClassScore(float(v), int(f), int(r), int(r) - unknowns.get(g, 0)) for g, (v, f, r) in sums.items()}
    )
