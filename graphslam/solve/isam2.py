"""Incremental solving with GTSAM's iSAM2, with the report that iSAM2 itself does not give.

iSAM2 relinearises a variable only when it moved by more than a threshold, so its estimate is that of a problem
linearised in part at old values. :meth:`Isam2Solver.gap` says by how much the objective lies above the batch optimum
reached from here, :meth:`Isam2Solver.solve_to_optimum` gets there, and a :class:`Solution` is never flagged converged
before.

GTSAM's ``update`` is not exception-safe: after a throw the object is dead. Every update therefore works on a copy
that replaces the old object only when it succeeded.
"""

from __future__ import annotations

import logging
import re
import time

import gtsam
import numpy as np
import scipy.sparse as sp

from graphslam.core.errors import ConfigError, SolverError
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.flat import FlatGraph
from graphslam.graph.gtsam_factors import gtsam_factor
from graphslam.graph.gtsam_values import from_gtsam, insert_value
from graphslam.graph.pose_graph import PoseGraph
from graphslam.graph.records import Record
from graphslam.graph.state import Values
from graphslam.solve.batch import linearisation_gap, optimise_graph, state_of
from graphslam.solve.solution import Solution, make_solution

log = logging.getLogger(__name__)


_FAILURES = (RuntimeError, IndexError, ValueError, SolverError)
"""What GTSAM throws, or we on what it returns."""


class FactorRejectedError(SolverError):
    """A factor broke an update and was taken out of the graph; everything else stands as before.

    Parameters
    ----------
    message : str
    factor_id : int
    """

    def __init__(self, message: str, factor_id: int) -> None:
        super().__init__(message)
        self.factor_id = factor_id


class Isam2Solver:
    """iSAM2 over a :class:`PoseGraph`.

    Parameters
    ----------
    graph : PoseGraph
        Read at every update; its values are written back.
    relinearize_threshold : float
        A position that moved by more than this [m] since it was linearised is linearised again.
    relinearize_angle : float
        The same for a heading [rad]. Submap factors are linear but for the heading of their base: an error of the
        linearisation is (change of heading) x (change of position), so headings are held much tighter.
    relinearize_skip : int
        Look only at every n-th update.
    """

    name = "isam2"

    def __init__(
        self,
        graph: PoseGraph,
        *,
        relinearize_threshold: float = 0.1,
        relinearize_angle: float = 0.01,
        relinearize_skip: int = 1,
    ) -> None:
        if not (relinearize_threshold > 0 and relinearize_angle > 0 and relinearize_skip >= 1):
            raise ConfigError(
                "iSAM2 needs positive thresholds and skip, got "
                f"{relinearize_threshold} m, {relinearize_angle} rad, {relinearize_skip}"
            )
        self.graph = graph
        self.relinearize_threshold = relinearize_threshold
        self.relinearize_angle = relinearize_angle
        self.relinearize_skip = relinearize_skip
        self.updates = 0
        self.rebuilds = 0
        self.seconds = 0.0
        self._isam: gtsam.ISAM2
        self._held: dict[int, tuple[Record, int]]  # factor id -> (record, slot)
        self._known: set[str]
        self._forget()

    # ---------------------------------------------------------------- verbs

    def update(self) -> None:
        """Feed what changed in the graph since the last update, and write the new estimate back.

        Raises
        ------
        IndeterminateError
            The graph does not determine some variables: names them and what would fix them. Nothing is changed; the
            next update tries again.
        FactorRejectedError
            One factor could not be solved with. It is removed from the graph; the solver is as it was before the
            update, and the other new factors enter at the next one.
        """
        t0 = time.perf_counter()
        try:
            self._update()
        finally:
            self.seconds += time.perf_counter() - t0

    def relinearize(self, *, max_passes: int = 50, tolerance: float = 1e-9) -> int:
        """Linearise everything anew where it stands until nothing moves by more than ``tolerance``.

        Each pass is one Gauss–Newton step of the whole problem, made by building iSAM2 again from the graph's record:
        GTSAM's own ``force_relinearize`` only overrides the skip and still passes over every variable within its
        threshold.

        Returns
        -------
        int
            Passes made.
        """
        self.update()
        t0 = time.perf_counter()
        passes = 0
        while passes < max_passes:
            passes += 1
            before = self.graph.values
            self._rebuild()
            if _distance(before, self.graph.values) <= tolerance:
                break
        self.seconds += time.perf_counter() - t0
        return passes

    def solve_to_optimum(self) -> None:
        """Go to the batch optimum reached from here, and linearise iSAM2 there."""
        self.update()
        t0 = time.perf_counter()
        optimum = optimise_graph(self.graph)
        self.graph.set_values(optimum.values)
        self._rebuild()
        self.graph.set_values(optimum.values)
        self.seconds += time.perf_counter() - t0

    def gap(self) -> float:
        """Linearisation gap: objective now less the batch optimum reached from here (nothing is changed)."""
        return linearisation_gap(self.graph)

    def covariance(self) -> JointCovariance:
        """Joint covariance at the present values (fully linearised there, not at iSAM2's old points)."""
        return self.graph.covariance()

    def solution(self, *, gap: bool = True) -> Solution:
        """Solution at the present values; ``gap=False`` saves the batch solve behind the gap."""
        return make_solution(
            self.name,
            self.graph,
            state_of(self.graph),
            iterations=self.updates,
            gap=self.gap() if gap else None,
            seconds=self.seconds,
        )

    # ---------------------------------------------------------------- inside

    def _forget(self) -> None:
        parameters = gtsam.ISAM2Params()
        metres, radians = self.relinearize_threshold, self.relinearize_angle
        thresholds = gtsam.ISAM2ThresholdMap()
        if self.graph.dim == 2:
            widths = {"x": (2, 1), "g": (2, 1), "l": (2, 0), "b": (2, 0)}
        else:  # GTSAM's Pose3 has its rotation first; the datum here has its heading last
            widths = {"x": (3, -3), "g": (3, 1), "b": (3, 0), "t": (0, 2)}
            widths |= {"v": (3, 0), "i": (3, -3)}  # of an IMU's velocity [m/s]; of its biases [rad/s, m/s²]
        for letter, (m, r) in widths.items():
            parts = [np.full(m, metres), np.full(abs(r), radians)]
            thresholds.insert((letter, np.concatenate(parts if r >= 0 else parts[::-1])))
        parameters.setRelinearizeThreshold(thresholds)
        parameters.relinearizeSkip = self.relinearize_skip
        parameters.findUnusedFactorSlots = True
        # Cholesky squares the condition number: an open chain of 900 poses with a centimetre of noise each is
        # "indeterminate" to it. QR costs about the same here.
        parameters.setFactorization("QR")
        self._isam = gtsam.ISAM2(parameters)
        self._held = {}
        self._known = set()

    def _update(self) -> None:
        new, gone = self._difference()
        if not self.graph.values.is_finite():
            raise SolverError("the graph holds values that are not finite; iSAM2 is not touched")
        changed = [i for i in gone if i in self.graph.records]  # re-keyed by a merge
        lost = self._known - set(self.graph.values.layout().names())
        if changed or lost:
            self._check_finite(new)
            self._rebuild()
            return
        if not new and not gone and self.updates:
            return
        self._check_finite(new)
        previous = (self._isam, dict(self._held), set(self._known))
        try:
            self._feed(gtsam.ISAM2(self._isam), new, gone)
            self._write_back()
        except _FAILURES as error:
            self._isam, self._held, self._known = previous
            # what fails step by step may be sound as a whole: a factor is blamed only if that fails, too
            self._rebuild(cause=error)
            return
        self.updates += 1

    def _difference(self) -> tuple[list[Record], list[int]]:
        """Records to add, and factor ids that iSAM2 holds and the graph does not (or no longer in that form)."""
        records = self.graph.records
        gone = [i for i, (r, _) in self._held.items() if records.get(i) is not r]
        new = [r for i, r in records.items() if i not in self._held or self._held[i][0] is not r]
        return new, gone

    def _feed(self, isam: gtsam.ISAM2, new: list[Record], gone: list[int]) -> None:
        """One GTSAM update on ``isam``, which then becomes ours."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        layout = self.graph.flat().layout
        fresh: dict[str, None] = {}
        for record in new:
            factors.push_back(gtsam_factor(record, self.graph.origin))
            for name in record.variables():
                if name != "x0" and name not in self._known:
                    fresh[name] = None
        for name in fresh:
            insert_value(values, name, self.graph.values, layout.row_of)
        parameters = gtsam.ISAM2UpdateParams()
        parameters.removeFactorIndices = [self._held[i][1] for i in gone]
        result = isam.update(factors, values, parameters)
        slots = list(result.getNewFactorsIndices())
        self._isam = isam
        for i in gone:
            del self._held[i]
        for record, slot in zip(new, slots):
            self._held[record.factor_id] = (record, slot)
        self._known |= set(fresh)

    def _write_back(self) -> None:
        estimate = from_gtsam(self._isam.calculateEstimate(), self.graph.values, self.graph.flat().layout)
        if not estimate.is_finite():
            raise SolverError("iSAM2 returned values that are not finite")
        self.graph.set_values(estimate)

    def _rebuild(self, cause: Exception | None = None) -> None:
        """Make iSAM2 again from the graph's record, linearised at the graph's values.

        ``cause`` is what an update step by step failed with.
        """
        old = (self._isam, self._held, self._known)
        new, gone = self._difference()
        self._forget()
        try:
            self._feed(self._isam, list(self.graph.records.values()), [])
            if cause is not None:
                self._check_normal_equations()
            self._write_back()
        except _FAILURES as error:
            self._isam, self._held, self._known = old
            self._blame(new, gone, cause or error)
        self.rebuilds += 1
        self.updates += 1

    def _check_finite(self, new: list[Record]) -> None:
        """Refuse a factor whose residual is not finite before GTSAM sees it (its own message would mislead)."""
        chi2 = FlatGraph(new, self.graph.flat().layout).evaluate(self.graph.values, hessian=False).chi2
        for record, value in zip(new, chi2):
            if not np.isfinite(value):
                self._reject(record, f"its residual is {value}")

    def _check_normal_equations(self) -> None:
        """Refuse what QR alone can solve: covariances and the batch optimum are made from squares of the Jacobian."""
        A = self.graph.flat().evaluate(self.graph.values).A
        if not np.all(np.isfinite(A.data if sp.issparse(A) else A)):
            raise SolverError("the squares of its Jacobian overflow")

    def _blame(self, new: list[Record], gone: list[int], error: Exception) -> None:
        """The update failed and iSAM2 is rolled back: find out why, and say it."""
        if gone:
            self.graph.diagnose().raise_if_bad()
        # the first new factor with which an update of those before it fails
        isam, held, known = self._isam, dict(self._held), set(self._known)
        try:
            for record in new:
                try:
                    self._feed(gtsam.ISAM2(self._isam), [record], [])
                    self._isam.calculateEstimate()
                except _FAILURES as cause:
                    self._isam, self._held, self._known = isam, held, known
                    self.graph.diagnose().raise_if_bad()
                    self._reject(record, _in_words(cause))
        finally:
            self._isam, self._held, self._known = isam, held, known
        self.graph.diagnose().raise_if_bad()
        raise SolverError(f"iSAM2 update failed ({_in_words(error)}); the solver is as it was before") from error

    def _reject(self, record: Record, why: str) -> None:
        self.graph.remove(record.factor_id, reason=f"rejected by iSAM2: {why}")
        log.warning("%s rejected: %s", record.label(), why)
        raise FactorRejectedError(
            f"{record.label()} cannot be solved with ({why}); it was removed, the solver is as it was before",
            record.factor_id,
        )


def _in_words(error: Exception) -> str:
    """GTSAM's message on one line, up to the variable that it names; the advice behind that is for programmers."""
    text = " ".join(str(error).split()) or type(error).__name__
    found = re.search(r"(?<=near variable )\d+ \(Symbol: (\w+)\)\.?", text)
    return text if found is None else f"{text[: found.start()]}{found[1]}"


def _distance(a: Values, b: Values) -> float:
    """Greatest change of any component."""
    parts = [np.abs(a.poses - b.poses).max(initial=0.0), np.abs(a.landmarks - b.landmarks).max(initial=0.0)]
    parts += [
        np.abs(a.velocities - b.velocities).max(initial=0.0),
        np.abs(a.imu_biases - b.imu_biases).max(initial=0.0),
    ]
    for one, other in ((a.datum, b.datum), (a.tilt, b.tilt)):
        if one is not None and other is not None:
            parts.append(np.abs(one - other).max())
    return float(max(parts))
