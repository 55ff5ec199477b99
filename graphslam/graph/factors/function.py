"""Factors of a user: a residual as a Python function of the values of some variables.

The Jacobian is that of central differences, unless the user gives a function for it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from graphslam.core.errors import ConfigError, SolverError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.graph.factors.batch import (
    FactorBatch,
    Fixed,
    Index,
    WhitenedRecord,
    dim_of,
    read_value,
    register_factor,
    safe_factor,
    unit_noise,
)
from graphslam.graph.noise import NO_KERNEL, RobustKernel, robust_terms
from graphslam.graph.variables import KINDS, Values, VariableLayout, gtsam_key, split_name

USABLE = ("x", "l", "datum", "tilt")
"""Kinds of variables that keep their name while the graph changes; rows of all others may be numbered anew."""
STEP = 1e-5
"""Of a central difference [m, rad]: truncation and rounding errors of a residual of size one are then about 1e-10."""


@dataclass(frozen=True, slots=True, eq=False)
class FunctionRecord(WhitenedRecord):
    """One factor of a user.

    Parameters
    ----------
    names : tuple of str
        Its variables, each once.
    residual : callable
        Values ``(size,)`` of the variables in that order → residual ``(d,)``, in the units of its covariance.
    jacobian : callable or None
        The same values → ``(d, Σ dof)``, by right tangents of poses.
    whitener : (d, d)
    """

    factor_id: int
    names: tuple[str, ...]
    residual: Callable[..., ArrayLike]
    jacobian: Callable[..., ArrayLike] | None
    whitener: Array
    robust: RobustKernel = NO_KERNEL
    group: str = "user"

    def variables(self) -> list[str]:
        """Names of the variables."""
        return list(self.names)

    def label(self) -> str:
        """Name for messages."""
        return f"{self.group} factor of {', '.join(self.names)} (factor {self.factor_id})"

    def error(self, values: Sequence[Array]) -> Array:
        """Residual ``(d,)``, not whitened."""
        return self._call(self.residual, values, (self.rows,), "residual")

    def linearised(self, values: Sequence[Array], dim: int) -> tuple[Array, Array]:
        """Whitened residual ``(d,)`` and Jacobian ``(d, Σ dof)``."""
        kinds = [split_name(n)[0] for n in self.names]
        r = self.error(values)
        if self.jacobian is not None:
            J = self._call(self.jacobian, values, (self.rows, sum(k.dof(dim) for k in kinds)), "Jacobian")
            return self.whitener @ r, self.whitener @ J
        columns = []
        for s, kind in enumerate(kinds):
            group, here = kind.pose_group(dim), list(values)
            for step in STEP * np.eye(kind.dof(dim)):
                ends = []
                for e in (step, -step):
                    here[s] = values[s] + e if group is None else group.compose(values[s], group.exp(e))
                    ends.append(self.error(here))
                columns.append((ends[0] - ends[1]) / (2.0 * STEP))
        return self.whitener @ r, self.whitener @ np.stack(columns, axis=1)

    def _call(self, function: Any, values: Sequence[Array], shape: tuple[int, ...], what: str) -> Array:
        try:
            out = np.atleast_1d(np.asarray(function(*(v.copy() for v in values)), dtype=np.float64))
        except Exception as error:
            raise SolverError(f"{self.label()}: its {what} failed ({type(error).__name__}: {error})") from error
        if out.shape != shape:
            raise SolverError(f"{self.label()}: its {what} has shape {out.shape}; wanted {shape}")
        return out


class FunctionBatch(FactorBatch):
    """Factors of a user, one call each."""

    record = FunctionRecord

    def __init__(self, records: Sequence[FunctionRecord], layout: VariableLayout) -> None:
        super().__init__(records, layout)
        self._dim = layout.dim
        places = [[(kind.word, row) for kind, row in map(split_name, r.names)] for r in records]
        self._places = [[(w, layout.row_of.get(k, -1) if w == "l" else k) for w, k in some] for some in places]
        flat = [place for some in self._places for place in some]
        self.arity = np.array([len(some) for some in places], dtype=np.int64)
        self.first = np.array([layout.first(w, k) for w, k in flat], dtype=np.int64)
        self.width = np.array([KINDS[w].dof(layout.dim) for w, _ in flat], dtype=np.int64)

    def _values(self, k: int, values: Values) -> list[Array]:
        return [values[word][row] for word, row in self._places[k]]

    def squared(self, values: Values) -> Array:
        """``rᵀ Λ r`` ``(k,)``."""
        rows = [r.whitener @ r.error(self._values(k, values)) for k, r in enumerate(self.records)]
        return np.array([float(r @ r) for r in rows])

    def blocks(self, values: Values, hessian: bool, H: Array, H_offset: Index, g: Array, g_offset: Index) -> Array:
        """See :meth:`FactorBatch.blocks`."""
        if not hessian:
            return robust_terms(self.squared(values), self.code, self.k)[0]
        rows = [r.linearised(self._values(k, values), self._dim) for k, r in enumerate(self.records)]
        loss, w = robust_terms(np.array([float(r @ r) for r, _ in rows]), self.code, self.k)
        for k, (r, J) in enumerate(rows):
            H[H_offset[k] : H_offset[k + 1]] = (w[k] * J.T @ J).ravel()
            g[g_offset[k] : g_offset[k + 1]] = w[k] * J.T @ r
        return loss

    @classmethod
    def gtsam(cls, record: FunctionRecord, fixed: Fixed) -> gtsam.NonlinearFactor:
        """A custom factor that calls the functions of the user."""
        dim, names = dim_of(fixed), record.names
        widths = [split_name(n)[0].dof(dim) for n in names]
        first = np.cumsum([0, *widths])
        free = [s for s, n in enumerate(names) if n not in fixed]

        def terms(values: gtsam.Values, H: list[Array] | None) -> Array:
            here = [fixed[n] if n in fixed else read_value(values, n, gtsam_key(n), dim) for n in names]
            if H is None:
                return np.asarray(record.whitener @ record.error(here))
            r, J = record.linearised(here, dim)
            for h, s in enumerate(free):
                H[h] = np.asfortranarray(J[:, first[s] : first[s + 1]])
            return r

        return safe_factor(unit_noise(record), [names[s] for s in free], [widths[s] for s in free], record.rows, terms)


register_factor(FunctionBatch)


def check_group(group: str) -> None:
    """A class of its own: the degrees of freedom of variables are counted by the classes of the package."""
    known = {c for kind in KINDS.values() for c in kind.classes}
    if not group or group in known:
        raise ConfigError(f"factors of the package have the group {group!r}; choose another name")
