"""Which IMUs of a log the graph gets, what came of them, and whether their axes are those of their mounting."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from graphslam.app.run.config import ImuConfig
from graphslam.app.run.metrics import Metrics
from graphslam.core.errors import MissingDataError
from graphslam.core.imu import Imu
from graphslam.core.log import DropCounter, SensorLog
from graphslam.evaluate.without_truth import class_consistency, two_sided
from graphslam.graph.factors.imu.config import ImuConfig as ImuFactorConfig
from graphslam.graph.noise import NO_KERNEL, Robust
from graphslam.graph.pose_graph import PoseGraph
from graphslam.solve.registry import Solver

logger = logging.getLogger(__name__)

CHECKED_AFTER = 30.0
"""Path that is there before axes are first looked at [s]."""
RECENTRED = 4
"""Times that ways are preintegrated anew about their bias, at most."""


def imus_of(log: SensorLog) -> dict[str, Imu]:
    """The IMUs of a log by name."""
    return {name: s for name, s in log.streams.items() if isinstance(s, Imu)}


class ImuPart:
    """The IMUs of a run: axes are looked at while it goes on, factors are made when its submaps are complete.

    Parameters
    ----------
    imus : dict of str to Imu
    config : ImuConfig

    Raises
    ------
    MissingDataError
        ``config.use`` names a stream that the log does not have.
    """

    def __init__(self, imus: dict[str, Imu], config: ImuConfig) -> None:
        self.imus, self.config = imus, config
        self._looked: set[str] = set()
        if config.use not in ("none", "auto") and config.use not in imus:
            raise MissingDataError(
                "imu.use names no IMU of the log",
                got=config.use,
                wanted=f"none, auto, {', '.join(imus) or '(it has none)'}",
            )

    def look(self, graph: PoseGraph) -> None:
        """Hold the axes of every IMU against the path, once, as soon as there is enough of it.

        Those the front end uses, too: a path that is made with wrong axes contradicts the forces.

        Raises
        ------
        DataError
            A mounting is contradicted and ``imu.axes`` is ``"refuse"``.
        """
        if self.config.axes == "ignore" or graph.dim != 3 or not graph.submaps:
            return
        now = graph.submaps[-1].interval[1]
        for name, imu in self.imus.items():
            begin = max(float(imu.times[0]), graph.submaps[0].interval[0]) if len(imu.times) else np.inf
            if name not in self._looked and now - begin >= CHECKED_AFTER:
                self._looked.add(name)
                graph.check_imu(imu, stream=name, axes=self.config.axes)

    def tie(self, graph: PoseGraph) -> int:
        """Give the graph the IMUs that are to be used; returns the number of factors.

        Raises
        ------
        EvidenceReusedError
            The stream that is named was used by the front end.
        """
        c, made = self.config, 0
        for name in self._wanted(graph):
            if graph.dim != 3:
                graph.note("imu-not-used", stream=name, why="the graph is in the plane")
                logger.warning("%s is not used: the graph is in the plane", name)
                continue
            kernel = NO_KERNEL if c.robust == "none" else Robust(c.robust, c.robust_width)
            factor = ImuFactorConfig(
                longest=c.longest, accelerometer=c.accelerometer, gravity=c.gravity, acceleration=c.acceleration,
                axes=c.axes, robust=kernel,
            )  # fmt: skip
            made += len(graph.add_imu(self.imus[name], stream=name, config=factor))
        return made

    def _wanted(self, graph: PoseGraph) -> list[str]:
        if self.config.use == "none":
            return []
        if self.config.use != "auto":
            return [self.config.use]
        spent = {e.stream for e in graph.ledger.entries()}
        return [name for name in self.imus if name not in spent]


def recentred(graph: PoseGraph, solver: Solver) -> None:
    """Solve, preintegrate anew about the biases found, and solve again, until nothing moves."""
    solver.solve_to_optimum()
    for _ in range(RECENTRED):
        if not graph.recentre_imu():
            return
        solver.solve_to_optimum()


def imu_metrics(out: Metrics, graph: PoseGraph, drops: DropCounter) -> None:
    """Biases as they are at the end, factors, and what was left out; also into the events and the counts."""
    said: list[dict[str, Any]] = [e for e in graph.events if e["event"] == "imu"]
    for stream in graph.imus:
        states = graph.imu_states(stream)
        mine = [e for e in said if e["stream"] == stream]
        for reason, n in (mine[-1]["dropped"] if mine else {}).items():
            drops.drop(stream, f"no factor: {reason}", n)
        if not states.order:
            continue
        row = states.bias[states.order[-1]]
        bias, P = graph.values.imu_biases[row], graph.covariance().marginal(f"imubias{row}")
        sigma = np.sqrt(np.diag(P))
        prefix = stream if stream.startswith("imu") else f"imu_{stream}"
        out.add(f"{prefix}_nodes", len(states.order))
        for name, part, unit in (("gyro", slice(0, 3), "rad/s"), ("force", slice(3, 6), "m/s²")):
            out.add(f"{prefix}_{name}_bias", float(np.linalg.norm(bias[part])), unit)
            out.add(f"{prefix}_{name}_bias_sigma", float(np.linalg.norm(sigma[part])), unit)
        graph.note("imu-bias", stream=stream, bias=bias.tolist(), sigma=sigma.tolist())
    _contradiction(graph)


def _contradiction(graph: PoseGraph) -> None:
    """Say so if the χ² of the ways is larger than it is by chance once in two thousand runs."""
    ways = class_consistency(graph).get("imu") if graph.imus else None
    if ways is None or not np.isfinite(ways.ratio):
        return
    high = two_sided(ways.ratio, ways.dof, 0.999)[1]
    if ways.ratio > high:
        graph.note("imu-contradicted", chi2_per_dof=ways.ratio, high=high)
        logger.warning(
            "submaps and IMU contradict each other (χ²/dof %.1f, at most %.1f): one of them states too little noise",
            ways.ratio,
            high,
        )
