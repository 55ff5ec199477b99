"""Incremental solving with GTSAM's iSAM2, with the report that iSAM2 itself does not give.

iSAM2 relinearises a variable only when it moved by more than a threshold, so its estimate is that of a problem
linearised in part at old values. :meth:`Isam2Solver.gap` says by how much the objective lies above the batch optimum
reached from here, :meth:`Isam2Solver.solve_to_optimum` gets there, and a :class:`Solution` is never flagged converged
before.

An update costs what it touches: only records that changed are looked at (the graph keeps a journal of them), nothing is
copied, and the estimate is read when somebody asks the graph for its values. GTSAM's ``update`` is not exception-safe:
after a throw the object is dead. What it held is then made again from the graph's own records; a factor is blamed only
if that fails, too.
"""

from __future__ import annotations

import logging
import math
import re
import time
from typing import Any

import gtsam
import numpy as np
import scipy.sparse as sp

from graphslam.core.errors import ConfigError, SolverError
from graphslam.core.geometry import Array
from graphslam.graph.covariance import JointCovariance
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import FactorRecord, gtsam_factor, pose_array
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.gtsam_values import from_gtsam, insert_values, value_of
from graphslam.graph.variables import Values, gtsam_key, split_name, thresholds
from graphslam.solve.batch import linearisation_gap, optimise_graph, state_of
from graphslam.solve.solution import Solution, make_solution

log = logging.getLogger(__name__)


_FAILURES = (RuntimeError, IndexError, ValueError, SolverError)
"""What GTSAM throws, or we on what it returns."""


class FactorRejectedError(SolverError):
    """A factor broke an update and was taken out of the graph; everything else stands as before."""

    def __init__(self, message: str, factor_id: int) -> None:
        super().__init__(message)
        self.factor_id = factor_id


class Isam2Solver:
    """iSAM2 over a :class:`FactorGraph`.

    Parameters
    ----------
    graph : FactorGraph
        Read at every update; its values are written back.
    relinearize_threshold : float
        A position that moved by more than this [m] since it was linearised is linearised again.
    relinearize_angle : float
        The same for a heading [rad]. Submap factors are linear but for the heading of their base: an error of the
        linearisation is (change of heading) x (change of position), so headings are held much tighter.
    relinearize_skip : int, optional
        Look for variables that moved at every n-th update only: looking costs as much as there are variables. By
        default 10, and 1 where there are landmarks, which are associated by where the poses are thought to be. A
        factor between two nodes that were there before, a loop, has them looked at in any case.
    """

    name = "isam2"

    def __init__(
        self,
        graph: FactorGraph,
        *,
        relinearize_threshold: float = 0.1,
        relinearize_angle: float = 0.01,
        relinearize_skip: int | None = None,
    ) -> None:
        if not (relinearize_threshold > 0 and relinearize_angle > 0 and (relinearize_skip or 1) >= 1):
            raise ConfigError(
                "iSAM2 needs positive thresholds and skip, got "
                f"{relinearize_threshold} m, {relinearize_angle} rad, {relinearize_skip}"
            )
        self.graph = graph
        # Cholesky squares the condition number: an open chain of 900 poses with a centimetre of noise each is
        # "indeterminate" to it. QR costs about the same in the plane, and four times as much in space.
        self.factorization = "QR"
        self.relinearize_threshold = relinearize_threshold
        self.relinearize_angle = relinearize_angle
        self.relinearize_skip = relinearize_skip
        self.updates = 0
        self.rebuilds = 0
        self.seconds = 0.0
        self._isam: Any  # gtsam.ISAM2, or None before the first update
        self._held: dict[int, tuple[FactorRecord, int]]  # factor id -> (record, slot)
        self._known: set[str]
        self._read: int  # entries of the graph's journal that were taken in
        self._since_pull = 0
        self._forget()

    # ---------------------------------------------------------------- verbs

    def update(self) -> None:
        """Feed what changed in the graph since the last update, and write the new estimate back."""
        t0 = time.perf_counter()
        try:
            self._update()
        finally:
            self.seconds += time.perf_counter() - t0

    def solve_to_optimum(self) -> None:
        """Go to the batch optimum reached from here, and linearise iSAM2 there."""
        self.update()
        t0 = time.perf_counter()
        optimum = optimise_graph(self.graph)
        self.graph.set_values(optimum.values)
        self._rebuild([], [])
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

    def _new(self) -> gtsam.ISAM2:
        """An empty iSAM2 for graphs of this kind."""
        parameters = gtsam.ISAM2Params()
        limits = gtsam.ISAM2ThresholdMap()
        for item in thresholds(self.graph.dim, self.relinearize_threshold, self.relinearize_angle).items():
            limits.insert(item)
        parameters.setRelinearizeThreshold(limits)
        landmarks = self.graph.structure.count("l") > 0
        parameters.relinearizeSkip = self.relinearize_skip or (1 if landmarks else 10)
        parameters.setFactorization(self.factorization)
        return gtsam.ISAM2(parameters)

    def _forget(self) -> None:
        self._isam = None
        self._held = {}
        self._known = set()
        self._read = 0

    def _update(self) -> None:
        new, gone = self._difference()
        changed = [i for i in gone if i in self.graph.records]  # re-keyed by a merge
        lost = self._known - set(self.graph.structure.layout().names()) if gone else set()
        if changed or lost:
            self._rebuild(new, gone)
        elif new or gone or not self.updates:
            self._check_fresh(new)
            try:
                self._feed(new, gone)
                self._promise(new)
            except _FAILURES as error:
                # what fails step by step may be sound as a whole: a factor is blamed only if that fails, too
                self._rebuild(new, gone, cause=error)
            else:
                self.updates += 1
        self._read = len(self.graph.records.journal)

    def _check_fresh(self, new: list[FactorRecord]) -> None:
        """Variables that iSAM2 is to hear of start at numbers."""
        for name in {n for r in new for n in r.variables()} - self._known - {"x0"}:
            if not np.all(np.isfinite(value_of(self.graph.structure, name, self.graph.landmark_rows))):
                raise SolverError(f"{name} starts at a value that is not finite; iSAM2 is not touched")

    def _difference(self) -> tuple[list[FactorRecord], list[int]]:
        """Records to add, and factor ids that iSAM2 holds and the graph does not (or no longer in that form)."""
        records, new, gone = self.graph.records, [], []
        for i in dict.fromkeys(self.graph.records.journal[self._read :]):
            now, held = records.get(i), self._held.get(i)
            if held is not None and held[0] is not now:
                gone.append(i)
            if now is not None and (held is None or held[0] is not now):
                new.append(now)
        return new, gone

    def _feed(self, new: list[FactorRecord], gone: list[int]) -> None:
        """One update of GTSAM's."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        fresh: dict[str, None] = {}
        for record in new:
            factors.push_back(gtsam_factor(record, self.graph.origin))
            for name in record.variables():
                if name != "x0" and name not in self._known:
                    fresh[name] = None
        insert_values(values, fresh, self.graph.structure, self.graph.landmark_rows)
        parameters = gtsam.ISAM2UpdateParams()
        parameters.removeFactorIndices = [self._held[i][1] for i in gone]
        loops = (isinstance(r, BetweenRecord) and fresh.keys().isdisjoint(r.variables()) for r in new)
        parameters.force_relinearize = any(loops)
        if self._isam is None:
            self._isam = self._new()
        slots = list(self._isam.update(factors, values, parameters).getNewFactorsIndices())
        for i in gone:
            del self._held[i]
        for record, slot in zip(new, slots):
            self._held[record.factor_id] = (record, slot)
        self._known |= set(fresh)

    def value(self, name: str) -> Array:
        """The present estimate of one variable that iSAM2 holds."""
        kind, dim, key = split_name(name)[0], self.graph.dim, gtsam_key(name)
        group = kind.pose_group(dim)
        if group is not None:
            pose = self._isam.calculateEstimatePose2 if dim == 2 else self._isam.calculateEstimatePose3
            return pose_array(pose(key))
        return np.array(self._isam.calculateEstimateVector(key))

    def _is_finite(self, name: str) -> bool:
        if name[0] != "x":
            return bool(np.all(np.isfinite(self.value(name))))
        key = gtsam_key(name)
        if self.graph.dim == 2:
            pose = self._isam.calculateEstimatePose2(key)
            return math.isfinite(pose.x() + pose.y() + pose.theta())
        return math.isfinite(self._isam.calculateEstimatePose3(key).matrix().sum())

    def holds(self, name: str) -> bool:
        """Is that variable in iSAM2?"""
        return name in self._known

    def _promise(self, new: list[FactorRecord]) -> None:
        """The graph's values are those of iSAM2 from now on; they are read when somebody asks for them.

        A residual that is not finite spreads over all variables of its factor, so that one of each new factor tells:
        the last, which most of those that came together share.
        """
        for name in {next((n for n in reversed(r.variables()) if n != "x0"), None) for r in new} - {None}:
            if not self._is_finite(str(name)):
                raise SolverError("iSAM2 returned values that are not finite")
        self.graph.expect(self)
        self._since_pull += 1
        if self._since_pull > max(100, len(self._known) // 10):  # what a rebuild would begin at stays near
            self._since_pull = 0
            _ = self.graph.values

    def pull(self, structure: Values) -> Values:
        """All values: those that iSAM2 holds as it has them, others as they are in ``structure``."""
        estimate = from_gtsam(self._isam.calculateEstimate(), structure, self.graph.landmark_rows)
        if not estimate.is_finite():
            raise SolverError("iSAM2 returned values that are not finite")
        return estimate

    def _rebuild(self, new: list[FactorRecord], gone: list[int], cause: Exception | None = None) -> None:
        """Make iSAM2 again from the graph's record, linearised at the graph's values.

        ``cause`` is what an update step by step failed with.
        """
        if cause is not None:
            self.graph.expect(None)  # the object that knew better is dead
            try:
                self._check_finite(new)
            except SolverError:
                ids = {r.factor_id for r in new}
                self._restore([r for i, r in self.graph.records.items() if i not in ids])
                raise
        _ = self.graph.values  # while the old object can tell
        self._forget()
        try:
            self._feed(list(self.graph.records.values()), [])
            if cause is not None:
                self._check_normal_equations()
            self.graph.set_values(self.pull(self.graph.values))
        except _FAILURES as error:
            self._blame(new, gone, cause or error)
        self._read = len(self.graph.records.journal)
        self.rebuilds += 1
        self.updates += 1

    def _check_finite(self, new: list[FactorRecord]) -> None:
        """Refuse a factor whose residual is not finite (GTSAM's own message would mislead)."""
        if not self.graph.values.is_finite():
            raise SolverError("the graph holds values that are not finite; iSAM2 is not touched")
        chi2 = FactorArrays(new, self.graph.values.layout()).evaluate(self.graph.values, hessian=False).chi2
        for record, value in zip(new, chi2):
            if not np.isfinite(value):
                self._reject(record, f"its residual is {value}")

    def _check_normal_equations(self) -> None:
        """Refuse what QR alone can solve: covariances and the batch optimum are made from squares of the Jacobian."""
        A = self.graph.flat().evaluate(self.graph.values).A
        if not np.all(np.isfinite(A.data if sp.issparse(A) else A)):
            raise SolverError("the squares of its Jacobian overflow")

    def _blame(self, new: list[FactorRecord], gone: list[int], error: Exception) -> None:
        """The whole graph fails, too: find out why, and say it."""
        if gone:
            self._forget()
            self.graph.diagnose().raise_if_bad()
        # the first new factor with which an update of those before it fails
        names = {r.factor_id for r in new}
        before = [r for i, r in self.graph.records.items() if i not in names]
        self._restore(before)
        for record in new:
            try:
                self._feed([record], [])
                self._isam.calculateEstimate()
            except _FAILURES as cause:
                self._restore(before)
                self.graph.diagnose().raise_if_bad()
                self._reject(record, _in_words(cause))
        self.graph.diagnose().raise_if_bad()
        raise SolverError(f"iSAM2 update failed ({_in_words(error)}); the solver is as it was before") from error

    def _restore(self, records: list[FactorRecord]) -> None:
        """Hold these records and no others, as far as they can be solved."""
        self._forget()
        try:
            self._feed(records, [])
            self._isam.calculateEstimate()
        except _FAILURES:  # then the next update makes it anew
            self._forget()

    def _reject(self, record: FactorRecord, why: str) -> None:
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
