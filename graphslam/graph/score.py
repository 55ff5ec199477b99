"""The objective of a graph per factor class, with χ²/dof, which shows whether the assumed noise is too small."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from graphslam.core.geometry import Array
from graphslam.core.markup import html_table
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.variables import KINDS


@dataclass(frozen=True, slots=True)
class ClassScore:
    """``χ²`` of one factor class.

    Parameters
    ----------
    chi2 : float
        ``Σ rᵀ P⁻¹ r`` (``Σ 2 ρ`` under a robust kernel).
    factors, rows : int
        Number of factors, and of scalars they measure.
    dof : int
        ``rows`` minus the unknowns that this class introduces: poses and landmarks for submaps, the datum for GPS,
        biases for their priors, the tilt for attitudes, velocities and biases for IMU factors. The sum over the classes
        is the dof of the graph.
    """

    chi2: float
    factors: int
    rows: int
    dof: int

    @property
    def chi2_per_dof(self) -> float:
        """About 1 if the covariances are consistent; ``nan`` without redundancy."""
        return self.chi2 / self.dof if self.dof > 0 else float("nan")


@dataclass(frozen=True, slots=True)
class GraphScore:
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
        """Number of rows minus number of states."""
        return sum(c.dof for c in self.classes.values())

    def _repr_html_(self) -> str:
        rows = [
            {"class": n, "factors": c.factors, "χ²": c.chi2, "dof": c.dof, "χ²/dof": c.chi2_per_dof}
            for n, c in self.classes.items()
        ]
        return html_table(rows, ["class", "factors", "χ²", "dof", "χ²/dof"])


def score_graph(flat: FactorArrays, chi2: Array) -> GraphScore:
    """Sum ``chi2`` ``(f,)``, in the order of ``flat.records``, by class."""
    lay = flat.layout
    sums: dict[str, list[float]] = {}
    for name, factors, rows in sorted(flat.classes(), key=lambda c: int(c[1].min())):
        c = sums.setdefault(name, [0.0, 0, 0])
        c[0] += sum(chi2[factors].tolist())
        c[1] += len(factors)
        c[2] += int(rows.sum())
    unknowns: dict[str, int] = {}
    for word, kind in KINDS.items():
        free = lay.stop(word) - lay.start(word)
        if free and word == "imubias" and "imu" in sums:  # those that have a factor of their own, and the others
            own = min(free, kind.dof(lay.dim) * int(sums.get("imu-bias", [0.0, 0, 0])[1]))
            unknowns["imu-bias"] = unknowns.get("imu-bias", 0) + own
            unknowns["imu"] = unknowns.get("imu", 0) + free - own
        elif free:
            owner = next((c for c in kind.classes if c in sums), next(iter(sums), ""))
            unknowns[owner] = unknowns.get(owner, 0) + free
    return GraphScore(
        {g: ClassScore(float(v), int(f), int(r), int(r) - unknowns.get(g, 0)) for g, (v, f, r) in sums.items()}
    )
