"""Incremental solver with GTSAM's iSAM2, with convergence diagnostics.

iSAM2 relinearises a variable only if it moved by more than a threshold, so its estimate is partly linearised at old
values. :func:`~graphslam.solve.batch.linearisation_gap` is the difference of the objective to the batch optimum reached
from here, :meth:`Isam2Solver.solve_to_optimum` goes there, and only then a :class:`Solution` is flagged converged.

With the datum ``T_gps_world`` as a variable of iSAM2, each GPS fix would change all poses that depend on the datum. So
iSAM2 has the poses in the GPS frame as soon as the graph has a datum and all factors are relative to it. The first base
is then free, a fix is a factor on one node, and datum and tilt follow from the first base. It is the same problem in
other coordinates, with the same optimum.

An update processes only changed records (from the journal of the graph), copies nothing, and the estimate is read
lazily when the values of the graph are used. GTSAM's ``update`` is not exception-safe: after an exception the object is
unusable. It is then rebuilt from the records of the graph; a factor is rejected only if that fails, too.
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
from graphslam.core.poses import group_of
from graphslam.core.se3 import quat_to_matrix
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.attitude import DOWN, AttitudeRecord
from graphslam.graph.factors.batch import FactorRecord, Fixed, batch_of, gtsam_factor, gtsam_pose, pose_array
from graphslam.graph.factors.between import BetweenRecord
from graphslam.graph.factors.gps import datum_of, level_datum_pose
from graphslam.graph.gtsam_values import PLACED, from_gtsam, insert_values, placed, value_of
from graphslam.graph.variables import Values, gtsam_key, split_name, thresholds
from graphslam.solve.batch import best_optimum, linearisation_gap, state_of
from graphslam.solve.solution import Solution, make_solution

log = logging.getLogger(__name__)


LEVEL = 1e-7
"""Standard deviation of the tilt of a first base that is level by definition [rad]."""

_FAILURES = (RuntimeError, IndexError, ValueError, SolverError)
"""Exceptions of GTSAM, or of the checks of its results."""


class FactorRejectedError(SolverError):
    """A factor made an update fail and was removed from the graph; everything else is unchanged."""

    def __init__(self, message: str, factor_id: int) -> None:
        super().__init__(message)
        self.factor_id = factor_id


class Isam2Solver:
    """iSAM2 over a :class:`FactorGraph`.

    Parameters
    ----------
    graph : FactorGraph
        Read at every update; the result is written to its values.
    relinearize_threshold : float
        A position that moved by more than this [m] since its linearisation is relinearised.
    relinearize_angle : float
        The same for a heading [rad]. Submap factors are linear except for the heading of their base. The linearisation
        error is (change of heading) x (change of position), so the limit for headings is tighter.
    relinearize_skip : int, optional
        Relinearisation is checked only at every n-th update, because the check costs time for all variables. Default
        10; 1 with landmarks, because their association uses the poses. A loop (factor between two existing nodes)
        always triggers the check.
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
        # Cholesky squares the condition number and fails for an open chain of 900 poses with 1 cm of noise each. QR
        # costs about the same in 2-D, and four times as much in 3-D.
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
        self._fixed: Fixed  # constants of the factors in iSAM2: the first base, or datum and tilt
        self._world_factor: int | None = None  # id of a factor that depends on the world frame
        self._read: int  # processed entries of the graph's journal
        self._since_pull = 0
        self._force = False
        self._forget()

    # ---------------------------------------------------------------- interface

    def update(self, *, relinearize: bool = False) -> None:
        """Add the changes of the graph since the last update; ``relinearize``: whatever ``relinearize_skip``."""
        self._force = relinearize
        t0 = time.perf_counter()
        try:
            self._update()
        finally:
            self.seconds += time.perf_counter() - t0

    def solve_to_optimum(self) -> None:
        """Solve to the batch optimum reached from here, and relinearise iSAM2 there."""
        self.update()
        t0 = time.perf_counter()
        optimum = best_optimum(self.graph)
        self.graph.set_values(optimum.values)
        self._rebuild([], [])
        self.graph.set_values(optimum.values)
        self.seconds += time.perf_counter() - t0

    def solution(self, *, gap: bool = True) -> Solution:
        """Solution at the current values; ``gap=False`` saves the batch solve for the gap."""
        return make_solution(
            self.name,
            self.graph,
            state_of(self.graph),
            iterations=self.updates,
            gap=linearisation_gap(self.graph) if gap else None,
            seconds=self.seconds,
        )

    # ---------------------------------------------------------------- inside

    def _new(self) -> gtsam.ISAM2:
        """An empty iSAM2 with the parameters for this graph."""
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
        self._fixed = {"x0": self.graph.origin}

    def _update(self) -> None:
        new, removed = self._difference()
        changed = [i for i in removed if i in self.graph.records]  # re-keyed by a merge
        lost = self._known - {"x0", *self.graph.structure.layout().names()} if removed else set()
        moves = self._isam is not None and self._in_gps_frame(new) != ("x0" not in self._fixed)  # to the other frame
        if changed or lost or moves:
            self._rebuild(new, removed)
        elif new or removed or self._force or not self.updates:
            self._check_fresh(new)
            try:
                self._feed(new, removed)
                self._promise(new)
            except _FAILURES as error:
                # the complete graph may still be solvable: a factor is rejected only if that fails, too
                self._rebuild(new, removed, cause=error)
            else:
                self.updates += 1
        self._read = len(self.graph.records.journal)

    def _check_fresh(self, new: list[FactorRecord]) -> None:
        """Check that the initial values of new variables are finite."""
        for name in {n for r in new for n in r.variables()} - self._known - self._fixed.keys():
            if not np.all(np.isfinite(value_of(self.graph.structure, name, self.graph.landmark_rows))):
                raise SolverError(f"{name} starts at a value that is not finite; iSAM2 is not touched")

    def _difference(self) -> tuple[list[FactorRecord], list[int]]:
        """Records to add, and ids of factors that were removed or changed in the graph."""
        records, new, removed = self.graph.records, [], []
        for i in dict.fromkeys(self.graph.records.journal[self._read :]):
            now, held = records.get(i), self._held.get(i)
            if held is not None and held[0] is not now:
                removed.append(i)
            if now is not None and (held is None or held[0] is not now):
                new.append(now)
        return new, removed

    def _in_gps_frame(self, new: list[FactorRecord]) -> bool:
        """Can iSAM2 have the poses in the GPS frame? ``new``: records that it does not have yet."""
        if self.graph.structure.datum is None or self._world_factor in self.graph.records:
            return False
        start = "x0" in self._fixed
        if start and not any("datum" in r.variables() for r in new):
            return False
        records = self.graph.records.values() if start else new
        self._world_factor = next((r.factor_id for r in records if not batch_of(type(r)).relative), None)
        return self._world_factor is None

    def _frame(self) -> Any:
        """``T_gps_world`` in GTSAM's form; None if poses are in the world frame."""
        if "x0" in self._fixed:
            return None
        if "x0" not in self._known:
            s = self.graph.structure
            return gtsam_pose(s.datum if self.graph.dim == 2 else level_datum_pose(s.datum, s.tilt))
        return self._pose("x0").compose(gtsam_pose(self.graph.origin).inverse())

    def _feed(self, new: list[FactorRecord], removed: list[int]) -> None:
        """One update of GTSAM."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        fresh: dict[str, None] = {}
        if self._isam is None and self._in_gps_frame(new):
            self._fixed = {"datum": np.zeros(3)} if self.graph.dim == 2 else {"datum": np.zeros(4), "tilt": np.zeros(2)}
        for record in new:
            factors.push_back(gtsam_factor(record, self._fixed))
            for name in record.variables():
                if name not in self._fixed and name not in self._known:
                    fresh[name] = None
        insert_values(values, fresh, self.graph.structure, self.graph.landmark_rows, self._frame())
        if self._isam is None and "tilt" in self._fixed and self.graph.structure.tilt is None:
            level = quat_to_matrix(self.graph.origin[3:]).T @ DOWN  # z of the world is up
            factors.push_back(gtsam_factor(AttitudeRecord(-1, 0, level, np.eye(2) / LEVEL), self._fixed))
        parameters = gtsam.ISAM2UpdateParams()
        parameters.removeFactorIndices = [self._held[i][1] for i in removed]
        loops = (isinstance(r, BetweenRecord) and fresh.keys().isdisjoint(r.variables()) for r in new)
        parameters.force_relinearize = self._force or any(loops)
        if self._isam is None:
            self._isam = self._new()
        slots = list(self._isam.update(factors, values, parameters).getNewFactorsIndices())
        for i in removed:
            del self._held[i]
        for record, slot in zip(new, slots):
            self._held[record.factor_id] = (record, slot)
        self._known |= set(fresh)

    def value(self, name: str) -> Array:
        """The current estimate of one variable in iSAM2."""
        kind, frame = split_name(name)[0], self._frame()
        if kind.pose_group(self.graph.dim) is not None:
            pose = self._pose(name)
            return pose_array(pose if frame is None else frame.between(pose))
        value = np.array(self._isam.calculateEstimateVector(gtsam_key(name)))
        return value if frame is None or kind.word not in PLACED else np.array(frame.transformTo(value))

    def _pose(self, name: str) -> Any:
        """A pose as iSAM2 has it."""
        read = self._isam.calculateEstimatePose2 if self.graph.dim == 2 else self._isam.calculateEstimatePose3
        return read(gtsam_key(name))

    def _is_finite(self, name: str) -> bool:
        if name[0] != "x":
            return bool(np.all(np.isfinite(self.value(name))))
        return math.isfinite(self._pose(name).matrix().sum())

    def holds(self, name: str) -> bool:
        """Whether the variable is in iSAM2."""
        return name in self._known

    def _promise(self, new: list[FactorRecord]) -> None:
        """Let the graph read its values from iSAM2, lazily, when they are used.

        A residual that is not finite affects all variables of its factor, so it is sufficient to check one per new
        factor: the last, which factors of one update often share.
        """
        for name in {next((n for n in reversed(r.variables()) if n not in self._fixed), None) for r in new} - {None}:
            if not self._is_finite(str(name)):
                raise SolverError("iSAM2 returned values that are not finite")
        self.graph.expect(self)
        self._since_pull += 1
        if self._since_pull > max(100, len(self._known) // 10):  # limits the age of the start values of a rebuild
            self._since_pull = 0
            _ = self.graph.values

    def pull(self, structure: Values) -> Values:
        """All values: from iSAM2 if it has them, otherwise from ``structure``."""
        frame = self._frame()
        T_gps_world = None if frame is None else pose_array(frame)
        like = structure if T_gps_world is None else placed(structure, T_gps_world)
        estimate = from_gtsam(self._isam.calculateEstimate(), like, self.graph.landmark_rows)
        if T_gps_world is not None:
            estimate = placed(estimate, group_of(T_gps_world).inverse(T_gps_world))
            estimate.poses[0] = self.graph.origin
            estimate.datum, tilt = datum_of(T_gps_world)
            if structure.tilt is not None:
                estimate.tilt = tilt
        if not estimate.is_finite():
            raise SolverError("iSAM2 returned values that are not finite")
        return estimate

    def _rebuild(self, new: list[FactorRecord], removed: list[int], cause: Exception | None = None) -> None:
        """Rebuild iSAM2 from the graph's records, linearised at the graph's values.

        ``cause``: the error of the incremental update.
        """
        if cause is not None:
            self.graph.expect(None)  # the iSAM2 object is unusable
            try:
                self._check_finite(new)
            except SolverError:
                ids = {r.factor_id for r in new}
                self._restore([r for i, r in self.graph.records.items() if i not in ids])
                raise
        _ = self.graph.values  # read the estimate from the old object
        self._forget()
        try:
            self._feed(list(self.graph.records.values()), [])
            if cause is not None:
                self._check_normal_equations()
            self.graph.set_values(self.pull(self.graph.values))
        except _FAILURES as error:
            self._blame(new, removed, cause or error)
        self._read = len(self.graph.records.journal)
        self.rebuilds += 1
        self.updates += 1

    def _check_finite(self, new: list[FactorRecord]) -> None:
        """Reject a factor whose residual is not finite (the message of GTSAM would be misleading)."""
        if not self.graph.values.is_finite():
            raise SolverError("the graph holds values that are not finite; iSAM2 is not touched")
        chi2 = FactorArrays(new, self.graph.values.layout()).evaluate(self.graph.values, hessian=False).chi2
        for record, value in zip(new, chi2):
            if not np.isfinite(value):
                self._reject(record, f"its residual is {value}")

    def _check_normal_equations(self) -> None:
        """Reject systems that only QR can solve: covariances and the batch optimum use the squared Jacobian."""
        A = self.graph.flat().evaluate(self.graph.values).A
        if not np.all(np.isfinite(A.data if sp.issparse(A) else A)):
            raise SolverError("the squares of its Jacobian overflow")

    def _blame(self, new: list[FactorRecord], removed: list[int], error: Exception) -> None:
        """Find out why the whole graph fails, and raise a specific error."""
        if removed:
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
        """Rebuild iSAM2 with these records only, if they can be solved."""
        self._forget()
        try:
            self._feed(records, [])
            self._isam.calculateEstimate()
        except _FAILURES:  # the next update rebuilds it
            self._forget()

    def _reject(self, record: FactorRecord, why: str) -> None:
        self.graph.remove(record.factor_id, reason=f"rejected by iSAM2: {why}")
        log.warning("%s rejected: %s", record.label(), why)
        raise FactorRejectedError(
            f"{record.label()} cannot be solved with ({why}); it was removed, the solver is as it was before",
            record.factor_id,
        )


def _in_words(error: Exception) -> str:
    """GTSAM's message on one line, up to the name of the variable, without the advice for programmers."""
    text = " ".join(str(error).split()) or type(error).__name__
    found = re.search(r"(?<=near variable )\d+ \(Symbol: (\w+)\)\.?", text)
    return text if found is None else f"{text[: found.start()]}{found[1]}"
