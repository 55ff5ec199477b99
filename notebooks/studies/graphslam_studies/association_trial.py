"""One run of the study of association ambiguity: unknown data association, the same log for every algorithm.

All algorithms have the same noise model, confirmation rule and cuts; only ``known`` gets the identities. Local maps are
joined by the same rule (joint compatibility) and polished, so that differences are due to the front end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt

from graphslam.app.machine import one_blas_thread
from graphslam.app.run.front_ends import make_front_end
from graphslam.app.worlds import simulate
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array, se2_between, se2_inverse, se2_transform
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.submap import Submap
from graphslam.evaluate.association import pair_agreement
from graphslam.evaluate.consistency import nees, vector_pose_error
from graphslam.join.association import MapAssociationConfig
from graphslam.join.joined_map import JoinResult
from graphslam.join.optimise import optimise_from_join
from graphslam.join.order import join_sequential
from graphslam_studies.evaluate.association import AssociationErrors, association_errors, majority_identity
from graphslam_studies.evaluate.submap_consistency import submap_nees
from graphslam_studies.montecarlo.trials import Measurement

Ints = npt.NDArray[np.int64]
Options = Mapping[str, Any]

FIVE_SIGMA_3DOF = 32.0
"""D² of a pose (3 degrees of freedom) that a consistent estimate exceeds with probability 5.2e-7, as for 5 σ."""
MIN_HITS = 3
"""Observations required for a landmark to be output; the same for all algorithms."""

# name -> (front end, options besides the common ones); `known` joins by the true identities
LOCAL: dict[str, tuple[str, Options]] = {
    "known": ("rbpf-ekf", {"association": "known", "particles": 40}),
    "ekf-nn": ("ekf", {"association": "nearest", "handover": "filter"}),
    "ekf-jcbb": ("ekf", {"association": "jcbb", "handover": "filter"}),
    "ekf-jcbb-smoothed": ("ekf", {"association": "jcbb"}),
    "rbpf-40": ("rbpf-ekf", {"particles": 40}),
    "rbpf-100": ("rbpf-ekf", {"particles": 100}),
    "rbpf1-40": ("rbpf-ekf", {"particles": 40, "proposal": "1.0"}),
    "rbpf1-100": ("rbpf-ekf", {"particles": 100, "proposal": "1.0"}),
    "rbpf1-400": ("rbpf-ekf", {"particles": 400, "proposal": "1.0"}),
    "rbpf-paper": ("rbpf-ekf", {"particles": 40, "handover": "moments"}),
}
SINGLE: dict[str, Options] = {"ekf-slam-nn": {"association": "nearest"}, "ekf-slam-jcbb": {"association": "jcbb"}}


@dataclass(frozen=True)
class TrialConfig:
    """A world and the algorithms compared in it.

    Parameters
    ----------
    world : str
        Preset of the landmark field; the layout is random in every run.
    changes : tuple of (str, float)
        Parameters of the world that differ from the preset.
    metres : float
        Length of a submap [m]; cut by number of scans, the same for all algorithms.
    local, single : tuple of str
        Algorithms with local maps, and algorithms with a single map.
    max_nodes : int
        Maximum number of hypotheses that joint compatibility tests per scan.
    """

    world: str
    changes: tuple[tuple[str, float], ...] = ()
    metres: float = 40.0
    local: tuple[str, ...] = tuple(LOCAL)
    single: tuple[str, ...] = tuple(SINGLE)
    max_nodes: int = 5_000


def run_trial(config: TrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run (see :mod:`graphslam_studies.association_ambiguity` for their names)."""
    with one_blas_thread():
        return list(Trial(config, seed).run())


@dataclass
class Trial:
    """Log of one run, and all algorithms on it."""

    config: TrialConfig
    seed: int
    log: SensorLog = field(init=False)

    def __post_init__(self) -> None:
        changes: dict[str, Any] = dict(self.config.changes)
        self.log = simulate("landmark-field", seed=self.seed, preset=self.config.world, **changes)
        self.observations = self.log["landmarks"]

    def run(self) -> Iterator[Measurement]:
        """Metrics of every algorithm. One that fails with an error has ``failed`` = 1 and counts as diverged."""
        for name in (*self.config.local, *self.config.single):
            start = perf_counter()
            try:
                rows = list(self.judge_local(name) if name in LOCAL else self.judge_single(name))
            except GraphSlamError:
                rows = [Measurement(name, "diverged", 1.0)]
                failed = 1.0
            else:
                failed = 0.0
            yield from rows
            yield Measurement(name, "failed", failed)
            yield Measurement(name, "seconds_total", perf_counter() - start, timing=True)

    # ---------------------------------------------------------------- algorithms

    def submaps(self, name: str) -> list[Submap]:
        """Local maps (or the single map) of an algorithm."""
        world, noise = self.log.meta["config"], self.log.meta["noise"]
        options: dict[str, Any] = {
            "max_range": float(world["max_range"]),
            "motion": {"speed": noise["speed"], "steering": noise["steering"]},
            "min_hits": MIN_HITS,
        }
        kind, own = LOCAL.get(name) or ("ekf-slam", SINGLE[name])
        options |= dict(own)
        if kind.startswith("ekf"):
            options["max_nodes"] = self.config.max_nodes
        if kind != "ekf-slam":
            scans = round(self.config.metres / world["speed"] * world["scan_rate"])
            options["stopping"] = {"scans": max(scans, 2)}
        front = make_front_end(kind, options)
        return list(front.submaps(self.log, seed=SeedTree(self.seed).child("frontend")))

    def join(self, submaps: list[Submap], *, known: bool = False) -> JoinResult:
        """Join in sequence by joint compatibility (``known``: by identities), and polish."""
        rule = None if known else MapAssociationConfig(rule="joint", sensor_range=float(self.observations.max_range))
        return optimise_from_join(submaps, join_sequential(submaps, association=rule))

    # ---------------------------------------------------------------- figures

    def labels(self, submap: Submap) -> Ints:
        """Landmark index in the submap for every observation of the log ``(q,)``, -1 = none."""
        out = np.full(len(self.observations.ranges), -1, dtype=np.int64)
        assert submap.landmarks is not None
        assert submap.landmarks.detections is not None
        rows = submap.landmarks.detections
        out[rows[:, 0]] = rows[:, 1]
        return out

    def rows_of(self, submap: Submap) -> slice:
        """Observations of the scans of a submap."""
        t0, t1 = submap.interval
        first = 0 if submap.key == 0 else int(np.searchsorted(self.observations.times, t0, side="right"))
        last = int(np.searchsorted(self.observations.times, t1, side="right"))
        return slice(int(self.observations.offsets[first]), int(self.observations.offsets[last]))

    def identified(self, submap: Submap) -> Submap:
        """The submap with the majority true identity of every landmark; -1 = clutter."""
        names, what = majority_identity(self.labels(submap), self.truth_ids)
        assert submap.landmarks is not None
        ids = np.full(len(submap.landmarks), -1, dtype=np.int64)
        ids[names] = what
        return submap.with_ids(ids)

    @property
    def truth_ids(self) -> Ints:
        """True identity of every observation."""
        assert self.observations.ids is not None
        return np.asarray(self.observations.ids)

    def judge_local(self, name: str) -> Iterator[Measurement]:
        """Metrics of the local maps, then of the joined map."""
        start = perf_counter()
        submaps = self.submaps(name)
        yield Measurement(name, "seconds_frontend", perf_counter() - start, timing=True)
        assert self.log.truth is not None
        named = [self.identified(s) for s in submaps]
        errors = AssociationErrors(0, 0, 0, 0, 0, 0)
        whole = np.full(len(self.truth_ids), -1, dtype=np.int64)
        entry = 0
        for s in named:
            assert s.landmarks is not None
            rows, labels = self.rows_of(s), self.labels(s)
            errors = errors + association_errors(labels[rows], self.truth_ids[rows], min_hits=MIN_HITS)
            whole[labels >= 0] = labels[labels >= 0] + entry
            entry += len(s.landmarks)
            yield Measurement(name, "local_pose_nees", submap_nees(s, self.log.truth).exit, s.key)
        yield from self._association(name, errors, len(submaps))
        # within submaps: a landmark observed from two submaps counts as two here
        owner = np.repeat(np.arange(len(submaps)), [len(s.landmarks or ()) for s in named])
        inside = pair_agreement(whole, np.where(self.truth_ids >= 0, self.truth_ids + 1_000_000 * self._submap_of, -1))
        yield Measurement(name, "local_pair_precision", inside.precision)
        yield Measurement(name, "local_pair_recall", inside.recall)

        start = perf_counter()
        joined = self.join(submaps, known=name == "known")
        yield Measurement(name, "seconds_join", perf_counter() - start, timing=True)
        ids = np.concatenate(joined.submap_ids)
        yield from self._merges(name, owner, ids, np.concatenate([s.landmarks.ids for s in named if s.landmarks]))
        labels = np.where(whole >= 0, ids[np.maximum(whole, 0)], -1)
        m = len(joined.poses) - 1
        ends = np.array([s.interval[1] for s in submaps])
        position = {int(i): k for k, i in enumerate(joined.landmark_ids)}
        yield from self._map(
            name, labels, joined.landmarks, position, ends, joined.poses[1:], joined.pose_covariance(m)
        )

    def judge_single(self, name: str) -> Iterator[Measurement]:
        """Metrics of a single map over the whole run."""
        start = perf_counter()
        (submap,) = self.submaps(name)
        yield Measurement(name, "seconds_frontend", perf_counter() - start, timing=True)
        lm = submap.landmarks
        assert lm is not None
        labels = self.labels(submap)
        yield from self._association(name, association_errors(labels, self.truth_ids, min_hits=MIN_HITS), 1)
        position = {k: k for k in range(len(lm))}
        P = lm.dense_covariance()[:3, :3]
        end = np.array([submap.interval[1]])
        yield from self._map(name, labels, lm.positions, position, end, lm.exit_pose[None], P)

    @property
    def _submap_of(self) -> Ints:
        """Submap number of every observation ``(q,)``."""
        world = self.log.meta["config"]
        scans = max(round(self.config.metres / world["speed"] * world["scan_rate"]), 2)
        return np.repeat(np.arange(len(self.observations.times)) // scans, np.diff(self.observations.offsets))

    def _association(self, name: str, e: AssociationErrors, submaps: int) -> Iterator[Measurement]:
        yield Measurement(name, "wrong_share", e.wrong_share)
        real = int(np.sum(self.truth_ids >= 0))
        yield Measurement(name, "used_share", (e.detections - e.wrong) / max(real, 1))
        for quantity in ("landmarks", "spurious", "duplicated", "missed"):
            yield Measurement(name, f"local_{quantity}", getattr(e, quantity) / submaps)

    def _merges(self, name: str, owner: Ints, ids: Ints, what: Ints) -> Iterator[Measurement]:
        """Landmarks of different submaps: wrong merges and missed merges."""
        between = owner[:, None] < owner[None]
        together, same = ids[:, None] == ids[None], (what[:, None] == what[None]) & (what >= 0)[:, None]
        merged = int(np.sum(between & together))
        wrong = int(np.sum(between & together & ~same))
        yield Measurement(name, "merges", merged)
        yield Measurement(name, "wrong_merges", wrong)
        yield Measurement(name, "wrong_merge_share", wrong / merged if merged else 0.0)
        yield Measurement(
            name, "missed_merge_share", float(np.sum(between & same & ~together) / max(np.sum(between & same), 1))
        )

    def _map(
        self,
        name: str,
        labels: Ints,
        landmarks: Array,
        position: Mapping[int, int],
        ends: Array,
        poses: Array,
        covariance: Array,
    ) -> Iterator[Measurement]:
        """Errors of the final map against ground truth, in the frame of the first base."""
        truth = self.log.truth
        assert truth is not None
        agreement = pair_agreement(labels, self.truth_ids)
        yield Measurement(name, "pair_precision", agreement.precision)
        yield Measurement(name, "pair_recall", agreement.recall)
        base = truth.trajectory.interpolate(np.zeros(1))[0]
        true = se2_between(base, truth.trajectory.interpolate(ends))
        e = vector_pose_error(poses, true)
        off = np.hypot(e[:, 0], e[:, 1])
        end_nees = float(nees(e[-1], covariance))
        yield Measurement(name, "end_error", float(off[-1]))
        yield Measurement(name, "end_nees", end_nees)
        yield Measurement(name, "diverged", float(end_nees > FIVE_SIGMA_3DOF))
        if len(poses) > 1:
            yield Measurement(name, "pose_rmse", float(np.sqrt(np.mean(off**2))))
        names, what = majority_identity(labels, self.truth_ids)
        real = what >= 0
        at = {int(i): k for k, i in enumerate(truth.landmark_ids)}
        points = se2_transform(se2_inverse(base), truth.landmarks[[at[int(i)] for i in what[real]]])
        d = np.linalg.norm(landmarks[[position[int(i)] for i in names[real]]] - points, axis=1)
        yield Measurement(name, "map_rmse", float(np.sqrt(np.mean(d**2))))
        yield Measurement(name, "map_median", float(np.median(d)))
        yield Measurement(name, "map_landmarks", float(len(names)))
        yield Measurement(name, "map_spurious", float(np.sum(~real)))
        yield Measurement(name, "map_duplicated", float(np.sum(real) - len(np.unique(what[real]))))
