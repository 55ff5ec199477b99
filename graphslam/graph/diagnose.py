"""Find variables that a graph does not constrain, and suggest remedies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from scipy.sparse.csgraph import connected_components

from graphslam.core.errors import IndeterminateError
from graphslam.core.geometry import Array
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.variables import KINDS, Values, VariableLayout, split_name

# Eigenvalues of the unit-diagonal matrix below this are rounding errors: double precision keeps 1e-16 of the largest,
# and a well-constrained chain of a thousand submaps stays above 1e-9 (measured).
_RANK_TOLERANCE = 1e-13
# A variable is named if its share of a null direction is above this.
_SHARE = 1e-3


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Result of :func:`diagnose`.

    Parameters
    ----------
    unconstrained : tuple of str
        Names of variables that can move without changing the objective; empty if the graph determines everything.
    remedies : tuple of str
        One sentence per remedy.
    """

    unconstrained: tuple[str, ...] = ()
    remedies: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Is every variable constrained?"""
        return not self.unconstrained

    def raise_if_bad(self) -> None:
        """Raise :class:`~graphslam.core.errors.IndeterminateError` naming the variables and the remedies."""
        if not self.ok:
            names = ", ".join(self.unconstrained[:12]) + (" …" if len(self.unconstrained) > 12 else "")
            raise IndeterminateError(
                f"{len(self.unconstrained)} unconstrained variables: {names}; {' '.join(self.remedies)}",
                self.unconstrained,
            )


def unconnected_variables(flat: FactorArrays) -> tuple[list[str], int]:
    """Variables that no chain of factors connects to a fixed pose (structure only), and the number of their parts."""
    lay, (factor, variable) = flat.layout, flat.links
    ground = lay.size
    prior = np.concatenate([np.zeros(0, dtype=bool), *(np.full(len(f), f.prior) for f in flat.batches)])
    at = np.where(variable < 0, ground, variable)
    at, factor, priors = at[variable != -2], factor[variable != -2], prior
    # every factor is a node after the columns; a prior connects its variable to a known value
    rows = np.concatenate([at, np.full(int(priors.sum()), ground)])
    factors = ground + 1 + np.concatenate([factor, np.flatnonzero(priors)])
    size = ground + 1 + len(flat)
    links = sp.coo_matrix((np.ones(len(rows)), (rows, factors)), shape=(size, size))
    label = connected_components(links, directed=False)[1]
    names = lay.names()
    first = np.concatenate([[0], np.cumsum([split_name(n)[0].dof(lay.dim) for n in names])])[:-1].astype(np.intp)
    loose = np.flatnonzero(label[first] != label[ground])
    return [names[k] for k in loose.tolist()], len(np.unique(label[first[loose]]))


def diagnose(flat: FactorArrays, values: Values, *, waiting_fixes: int = 0) -> Diagnosis:
    """Find unconstrained variables by structure, then numerically.

    Parameters
    ----------
    values : Values
        Linearisation point.
    waiting_fixes : int
        GPS fixes without a datum yet (for the text of the remedy).
    """
    lay = flat.layout
    lost, _ = unconnected_variables(flat)
    if not lost:
        system = flat.evaluate(values)
        lost = null_variables(system.A, lay)
    if not lost:
        return Diagnosis()
    return Diagnosis(tuple(lost), tuple(_remedies(lost, flat, waiting_fixes)))


def null_variables(A: Array | sp.csc_matrix, lay: VariableLayout) -> list[str]:
    diagonal = np.asarray(A.diagonal())
    owner = np.array(lay.owner_of_columns(), dtype=object)
    if lay.size == 0:
        return []
    if not np.all(np.isfinite(diagonal)):
        return []  # an overflow is a broken factor, not a missing one
    if np.any(diagonal <= 0):
        return list(dict.fromkeys(owner[diagonal <= 0]))
    s = 1.0 / np.sqrt(diagonal)
    if sp.issparse(A):
        scaled = sp.csc_matrix(sp.diags(s) @ A @ sp.diags(s))
        shifted = sp.csc_matrix(scaled + 1e-12 * sp.eye(lay.size))  # keeps a singular matrix factorable
        w, V = spla.eigsh(scaled, k=min(12, lay.size - 1), sigma=0.0, OPinv=_inverse(shifted))
        V = V[:, w < 10 * _RANK_TOLERANCE]
    else:
        w, V = np.linalg.eigh(A * s[:, None] * s)
        V = V[:, w < _RANK_TOLERANCE * lay.size]
    weight = np.max(np.abs(V), axis=1) if V.shape[1] else np.zeros(lay.size)
    return list(dict.fromkeys(owner[weight > _SHARE]))


def _inverse(matrix: sp.csc_matrix) -> spla.LinearOperator:
    lu = spla.splu(matrix)
    return spla.LinearOperator(matrix.shape, matvec=lu.solve, dtype=np.float64)  # type: ignore[arg-type]


def _remedies(lost: Sequence[str], flat: FactorArrays, waiting: int) -> list[str]:
    out = []
    nodes = [n for n in lost if n[0] == "x"]
    if nodes:
        first = min(int(n[1:]) for n in nodes)
        out.append(
            f"x{first} is not connected to x{first - 1}: add a submap or a between-factor from x{first - 1} to it, "
            "or two landmarks that both sides saw."
            if flat.layout.dim == 2
            else f"x{first} is not connected to x{first - 1}: add a submap or a between-factor from x{first - 1} to it."
        )
    landmarks = [n for n in lost if n[0] == "l"]
    if landmarks and not nodes:
        out.append(f"{landmarks[0]} is in no submap with a usable covariance: remove it or add a submap that saw it.")
    if "datum" in lost:
        fixes = sum(r.group == "gps" for r in flat.records)
        out.append(f"the GPS datum has only {fixes} fixes ({waiting} waiting): it needs two that are metres apart.")
    kinds = {split_name(n)[0].word for n in lost}
    return out + list(dict.fromkeys(KINDS[w].remedy for w in KINDS if w in kinds and KINDS[w].remedy))
