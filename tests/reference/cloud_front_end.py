"""A front end that makes cloud submaps of a log: points along dead reckoning, without a filter or a map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from graphslam.core.dense import CloudMap
from graphslam.core.log import SensorLog
from graphslam.core.poses import group_of
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evidence.grid import EvidenceGrid
from graphslam_frontends.base import FrontEnd
from graphslam_frontends.odometry.make_steps import make_steps
from graphslam_frontends.odometry.step_config import StepConfig
from graphslam_frontends.odometry.steps import Steps


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudConfig:
    """Submaps of so much way."""

    steps: StepConfig = field(default_factory=StepConfig)
    """How the log becomes steps."""
    length: float = 10.0
    """Way of a submap [m]."""
    origins: bool = True
    """Whether clouds say from where their points were seen."""
    grid: bool = False
    """Whether submaps have a grid too."""


@dataclass(frozen=True)
class CloudFrontEnd(FrontEnd):
    """Dead reckoning in pieces, each with the cloud that was seen along it; covariances are dead reckoning's own."""

    name: ClassVar[str] = "clouds"
    config: CloudConfig

    def submaps(self, log: SensorLog, *, after: Submap | None = None, **_: Any) -> Iterator[Submap]:
        steps = make_steps(log, self.config.steps)
        ends = np.searchsorted(steps.path_length, np.arange(0.0, steps.path_length[-1], self.config.length))
        ends = np.append(ends[:-1], len(steps) - 1)  # the rest goes with the last but one
        for key, (a, b) in enumerate(pairwise(ends)):
            if after is None or key > after.key:
                yield self.one(steps, key, int(a), int(b))

    def one(self, steps: Steps, key: int, a: int, b: int) -> Submap:
        """The submap of steps a to b."""
        local, P = zip(*(steps.errors.between(a, k) for k in range(a, b + 1)))
        local, P = np.stack(local), np.stack(P)
        g = group_of(local)
        local[0], P[0] = g.identity, 0.0
        points, origins, scan = [], [], []
        grid = EvidenceGrid(0.2, dim=g.dim) if self.config.grid else None
        for k, T in enumerate(local):
            p, o, met = steps.scan(a + k)
            if grid is not None:
                grid.insert_scan(p, o, pose=T, returns=met)
            points.append(g.transform(np.broadcast_to(T, (int(met.sum()), g.size)), p[met]))
            origins.append(g.transform(T[None], o[:1] if len(o) else np.zeros((1, g.dim)))[0])
            scan.append(np.full(int(met.sum()), k))
        seen = {"origins": np.stack(origins), "scan": np.concatenate(scan)} if self.config.origins else {}
        return Submap(
            key=key,
            interval=(float(steps.times[a]), float(steps.times[b])),
            exit_pose=local[-1],
            exit_covariance=P[-1],
            trajectory=Trajectory(steps.times[a : b + 1], local, P),
            cloud=CloudMap(points=np.concatenate(points), **seen),
            grid=grid,
            uses=steps.uses,
            report={"ended": "length", "scans": b - a},
        )
