"""One row of the fault matrix, run and scored: what the user sees, and how far off the map is that he is given."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.stats import chi2

import graphslam as gs
from graphslam.app.run.run import Run
from graphslam.core.config import merge_options
from graphslam.core.errors import GraphSlamError
from graphslam.core.findings import Finding
from graphslam.core.log import SensorLog
from graphslam.core.poses import group_of
from graphslam.evaluate.metrics import Metrics, map_truth, truth_metrics, truth_metrics_in_space, truth_path
from tests.faults.grid_rows import Row
from tests.faults.grid_worlds import Drive

ERROR_MARGIN = (1.5, 0.2)
"""A path is worse than that of the clean run if it is so many times as far off, and so many metres more."""


@dataclass(frozen=True)
class Seen:
    """What came of a run: an error of ours, or a verdict with the score against the truth that the run did not have."""

    refused: str = ""
    lines: tuple[Finding, ...] = ()
    dropped: dict[str, int] = field(default_factory=dict)
    error: float = 0.0
    heading: float = 0.0
    exits: float = 0.0
    nodes: float = 0.0
    dof: float = 0.0

    @property
    def confident(self) -> bool:
        """NEES of exits or of nodes above what honest covariances reach once in a thousand runs.

        Exits are judged in the frames of their own submaps. Nodes are judged in the frame of the first, linearly, which
        means nothing where headings are off by tenths of a radian.
        """
        if not self.dof:
            return False
        bound = float(chi2.ppf(0.999, self.dof)) / self.dof
        return self.exits > bound or (self.nodes > bound and self.heading < 0.2)

    def codes(self, level: tuple[str, ...] = ("bad", "look")) -> set[str]:
        """Codes of the lines that ask the user to look."""
        return {f.code for f in self.lines if f.level in level}

    def silently_wrong(self, clean: Seen) -> bool:
        """Overconfident, worse than without the fault, and no line that the clean run does not have."""
        worse = self.error > ERROR_MARGIN[0] * clean.error + ERROR_MARGIN[1]
        return not self.refused and self.confident and worse and not self.codes() - clean.codes()


def score(run: Run, log: SensorLog) -> dict[str, float]:
    """RMSE of the nodes [m], of their headings [rad], NEES/dof of exits and of nodes, and the degrees of freedom."""
    truth, out = map_truth(log, run.submaps), Metrics()
    assert truth is not None
    assert run.solution is not None
    assert log.truth is not None
    path = truth_path(log, run.map.trajectory.times, run.submaps[0])
    if run.map.trajectory.dim == 2:
        truth_metrics(out, run.solution, truth, identities=True, path=path)
    else:
        truth_metrics_in_space(out, run.solution, truth, path=path)
    m = {r["key"]: r["value"] for r in out.rows}
    exits = []
    for s in run.submaps:
        g, own = group_of(s.exit_pose), s.trajectory
        assert own is not None
        a, b = log.truth.trajectory.interpolate(np.array(s.interval))
        # bases in space may stand level beside the body: the submap's own path says where the body is in its frame
        base = g.compose(a, g.inverse(own.poses[0]))
        end = g.compose(b, g.between(own.poses[-1], s.exit_pose))
        e = g.log(g.between(s.exit_pose, g.between(base, end)))
        exits.append(float(e @ np.linalg.solve(s.exit_covariance, e)))
    return {
        "error": m["pose_rmse"],
        "heading": float(np.deg2rad(m["heading_rmse"])),
        "exits": sum(exits) / m["nees_dof"],
        "nodes": m["nees_per_dof"],
        "dof": m["nees_dof"],
    }


def trial(row: Row | None, drive: Drive, frontend: str, *, seed: int = 1) -> Seen:
    """Run a front end on the drive with the fault; None: without."""
    options: Any = drive.of(frontend)
    log = drive.log
    if row is not None:
        options, log = merge_options(options, row.options), row.inject(log)
    assert row is None or log.truth is None
    try:
        run = gs.run(log if row else SensorLog(**{**_parts(log), "truth": None}), frontend=frontend, seed=seed,
                     config=options, progress=False)  # fmt: skip
    except GraphSlamError as error:
        return Seen(refused=str(error))
    return Seen("", tuple(run.verdict), dict(run.report["records_dropped"]), **score(run, drive.log))


def _parts(log: SensorLog) -> dict[str, Any]:
    return {k: getattr(log, k) for k in ("name", "streams", "read", "dropped", "meta")}
