"""Moving cars and people on the campus: share of their voxels removed from a map, and of static voxels lost.

``gone``: share of voxels hit by moving objects only that are not occupied in the map. ``lost``: share of the occupied
voxels of a map without moving objects that are not occupied in the map with them. Both maps use the estimated path.
``evidence``: map by sum of log-odds. ``outvoted``: also without voxels that were free in more moments than they were
occupied in. Evidence is summed per beam, so a person in front of a scanner for one second gives hundreds of hits,
 which a few later beams through the same voxels do not outweigh. With one vote per moment, they do.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from time import process_time

import numpy as np

from graphslam.app.machine import one_blas_thread
from graphslam.backend.back_end import BackEnd
from graphslam.core.geometry import Array
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam.core.se3 import se3_transform
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam.maps.moving import FREE, LEAST_FREE, Mask, known_state, near_ground
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.scan_window.front_end import ScanWindow
from graphslam_studies.campus_trial import CampusTrialConfig
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.sim.campus import simulate_campus

ALL = 1_000_000
"""Maximum number of beams of a step; large, so that all are used."""


def seen_through_voxels(grid: EvidenceGrid, moments: Iterable[EvidenceGrid]) -> tuple[Array, Mask]:
    """Occupied voxels of a map that were free in more moments than they were occupied in.

    Parameters
    ----------
    grid : EvidenceGrid
        3-D, z up.
    moments : iterable of EvidenceGrid
        Grids of single moments (one to a few seconds of scans each), with the lattice of the map. The threshold is
        half of :data:`~graphslam.maps.moving.FREE`, because few beams cross a voxel in one moment.

    Returns
    -------
    centres : (n, 3)
        Centres of the occupied voxels [m].
    moved : (n,) bool
    """
    occupied = np.asarray(grid.occupied_cloud())
    free, stopped = np.zeros(len(occupied), np.int64), np.zeros(len(occupied), np.int64)
    for moment in moments:
        state = known_state(moment, occupied, 0.5 * FREE)
        free += state < 0
        rows = np.flatnonzero(state > 0)
        stopped[rows[moment.occupied_at(occupied[rows])]] += 1
    return occupied, (free >= LEAST_FREE) & (free > stopped) & ~near_ground(occupied, occupied)


def run_moving_trial(config: CampusTrialConfig, seed: int) -> list[Measurement]:
    """All metrics of one run."""
    with one_blas_thread():
        return list(moving_figures(config, seed))


def moving_figures(config: CampusTrialConfig, seed: int) -> Iterator[Measurement]:
    """Simulate, estimate the path, build the map with and without moving objects, and compare."""
    begin = process_time()
    log = simulate_campus(config.campus, seed)
    end = BackEnd(config.back_end, "batch")
    for s in ScanWindow(config.front_end).submaps(log, seed=SeedTree(seed)):
        end.append(s)
    path = end.finish().trajectory()
    steps = replace(config.front_end.steps, most_points=ALL)
    make = Drawn(
        path, steps, EvidenceGrid(config.front_end.submap.voxel_size, model=config.front_end.submap.beam_model())
    )
    still, only = parted(log)
    standing, whole = make.grid(still)[0], make.grid(log)[0]
    hits = make.grid(only)[1]
    size = make.empty.voxel_size
    met: Array = (np.unique(np.floor(hits / size).astype(np.int64), axis=0) + 0.5) * np.float64(size)
    met = met[~standing.occupied_at(met)]
    known = np.asarray(standing.occupied_cloud())
    centres, moved = seen_through_voxels(whole, make.moments(log))
    dynamic = {tuple(k) for k in np.floor(centres[moved] / size).astype(np.int64).tolist()}

    def left(points: Array) -> Array:
        cells = np.floor(points / size).astype(np.int64).tolist()
        return whole.occupied_at(points) & ~np.array([tuple(k) in dynamic for k in cells], dtype=bool)

    for kind, there in (("evidence", whole.occupied_at), ("outvoted", left)):
        yield Measurement(kind, "gone", float(1.0 - np.mean(there(met))))
        yield Measurement(kind, "lost", float(1.0 - np.mean(there(known))))
        yield Measurement(kind, "failed", 0.0)
    yield Measurement("evidence", "voxels_moving", float(len(met)))
    yield Measurement("evidence", "voxels_standing", float(len(known)))
    yield Measurement("evidence", "seconds", process_time() - begin, timing=True)


class Drawn:
    """Maps of a log along one path, in one lattice."""

    def __init__(self, path: Trajectory, steps: StepConfig, empty: EvidenceGrid) -> None:
        self.path, self.steps, self.empty = path, steps, empty

    def grid(self, log: SensorLog) -> tuple[EvidenceGrid, Array]:
        """The map, and the end points of all beams with a return ``(n, 3)`` [m]."""
        out, hits = self.empty.empty(), [np.zeros((0, 3))]
        for points, origins, returns, T, reach in self._scans(log):
            out.insert_scan(points, origins, pose=T, max_range=reach, returns=returns)
            hits.append(se3_transform(T[None], points[returns]))
        return out, np.concatenate(hits)

    def moments(self, log: SensorLog) -> Iterator[EvidenceGrid]:
        """One map per step."""
        for points, origins, returns, T, reach in self._scans(log):
            out = self.empty.empty()
            out.insert_scan(points, origins, pose=T, max_range=reach, returns=returns)
            yield out

    def _scans(self, log: SensorLog) -> Iterator[tuple[Array, Array, np.ndarray, Array, float]]:
        steps = make_steps(log, self.steps)
        poses = self.path.interpolate(np.clip(steps.times, self.path.times[0], self.path.times[-1]))
        for k, T in enumerate(poses):
            points, origins, returns = steps.scan(k)
            if len(points):
                yield points, origins, returns, T, steps.max_range


def parted(log: SensorLog) -> tuple[SensorLog, SensorLog]:
    """The log without the beams that hit moving objects, and the log with only these beams."""
    assert log.truth is not None
    still, only = dict(log.streams), dict(log.streams)
    for name, labels in log.truth.moving.items():
        scans, met = log[name], labels.labels >= 0
        still[name] = replace(scans, ranges=np.where(met, np.nan, scans.ranges).astype(scans.ranges.dtype))
        only[name] = replace(scans, ranges=np.where(met, scans.ranges, np.nan).astype(scans.ranges.dtype))
    return replace(log, streams=still), replace(log, streams=only)
