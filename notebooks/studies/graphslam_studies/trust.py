"""The study ``trust``: verdicts computed without ground truth, compared with the true consistency of the map.

Worlds are random: robots among landmarks (:mod:`graphslam_studies.trust_worlds`: route, landmarks, robot, noise,
GPS receiver), and robots with scans (:class:`ScanWorld`: a park with a building, garages, lidars). Half of the random
landmark worlds have the noise that the log states; the others have one or two unmodelled errors. Further worlds have
one fault of ``docs/faults.md`` (:mod:`graphslam_studies.trust_faults`). ``graphslam.run`` maps each with default
options, i.e. front end, calibration, refinement and loop closures are chosen automatically.

In landmark worlds, the score is computed here, independently of the verdict, from the simulated poses and the
covariances of the graph. With GPS, poses are scored in the frame of the fixes, else in the frame of the first base.

Quantities
----------
``node``: mean NEES/n of the single nodes; ``node_dof``: effective degrees of freedom of this mean (node errors are
correlated: ``n² / ‖C‖²``); ``joint``, ``joint_dof``: NEES/n of all nodes jointly; ``rms``: position error [m];
``verdict``: index into :data:`WORDS`, the only metric if the log is refused; ``clean``. Runs with a 3-D graph or
without a graph are scored by the NEES of the run (``nees_per_dof``), as both ``joint`` and ``node``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from graphslam.app.run.pipeline import run
from graphslam.app.run.run import Run
from graphslam.app.run.summary import run_verdict
from graphslam.app.verdict.covariances import covariance_assessment
from graphslam.app.verdict.figures import RunMetrics
from graphslam.app.worlds import mesh_world, simulate
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import Array, se2_adjoint, se2_between, se2_compose, se2_inverse, se2_log
from graphslam.core.log import SensorLog
from graphslam.core.random import SeedTree
from graphslam_studies.evaluate.intervals import share_interval
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy, draw_runs, whole
from graphslam_studies.sim.lidar import drawn_imu, drawn_lidar, simulate_lidar
from graphslam_studies.trust_faults import FaultWorld, fault_worlds
from graphslam_studies.trust_worlds import TrustWorld, draw_world, true_in_frame, world_log

WORDS = ("consistent", "overconfident", "conservative", "not tested", "wrong", "refused")
"""Verdicts; ``refused``: there is no map."""
WRONG = 1.5
"""Above this NEES/n, the verdicts consistent and conservative are wrong."""
LARGE = 9.0
"""Above this NEES/n, a map is wrong: its RMS error is 3 σ."""
WORLDS_DRAWN = range(800, 860)
"""World numbers of the study. Some with lower numbers were used to develop rules and defaults, so they are excluded."""


@dataclass(frozen=True, kw_only=True)
class ScanWorld:
    """A world with scans and correct noise models.

    Parameters
    ----------
    kind : {"park", "laser", "garage", "lidar"}
        Landmarks and a planar laser in a building and the park around it; the same with the laser only; a panning laser
        in a random garage; a random lidar.
    number : int
        With the seed of a run, it determines the place, the robot and its noise.
    seconds : float
        Maximum duration of the log [s].
    """

    kind: str
    number: int
    seconds: float = 120.0
    clean: bool = True
    wrong: str = "nothing"
    gps: str = "none"

    def log(self, seed: int) -> SensorLog:
        """A log of the world, under a name without a preset."""
        number = int(SeedTree(seed).child("trust", self.kind, self.number).generator().integers(10**6))
        if self.kind == "lidar":
            config = replace(drawn_lidar(number), imu=drawn_imu(number), points=4000)
            place = ("garage", "building", "mine")[self.number % 3]
            layout = {"layout": f"drawn-{number % 1000}"} if place == "garage" else {}
            made = simulate_lidar(mesh_world(place, seed=number, **layout), number, config, most=self.seconds)
        elif self.kind == "garage":
            made = simulate("garage", preset="light", layout=f"drawn-{number % 1000}", seed=number)
            made = made.slice(made.interval[0], made.interval[0] + self.seconds)
        else:
            made = simulate("mixed", preset="quick", seed=number)
        if self.kind == "laser":
            made = replace(made, streams={k: v for k, v in made.streams.items() if k != "landmarks"})
        return replace(made, name="trust")


World = TrustWorld | ScanWorld | FaultWorld


def scored(found: Run, log: SensorLog) -> dict[str, float]:
    """Metrics of the node errors against the simulator, with the covariance from the graph."""
    if found.graph is None or found.graph.dim == 3:
        value = found.metrics.set_index("key")["value"]
        joint, dof = float(value.get("nees_per_dof", np.nan)), float(value.get("nees_dof", np.nan))
        return {"node": joint, "node_dof": dof, "joint": joint, "joint_dof": dof, "rms": float(value["path_rmse"])}
    return _scored_in_plane(found, log)


def _scored_in_plane(found: Run, log: SensorLog) -> dict[str, float]:
    """The same for a 2-D graph, computed from the joint covariance of its nodes."""
    g = found.graph
    assert g is not None
    nodes = np.array([s.node for s in g.submaps] + [g.submaps[-1].exit_node])
    times = np.array([s.interval[0] for s in g.submaps] + [g.submaps[-1].interval[1]])
    assert log.truth is not None
    known = log.truth.trajectory.times
    times = np.clip(times, known[0], known[-1])  # a corrected clock shifts the ends of the log
    fixes = g.values.datum is not None
    true, poses, lay = true_in_frame(log, times, gps=fixes), g.values.poses[nodes], g.flat().layout
    at = (
        np.concatenate([lay.columns("datum"), *(lay.pose_columns(nodes[1:]))])
        if fixes
        else np.concatenate(list(lay.pose_columns(nodes[1:])))
    )
    P = g.covariance().columns(at)
    first = 3 if fixes else 0
    J = np.zeros((len(nodes), 3, len(at)))
    for k in range(1, len(nodes)):
        J[k, :, first + 3 * (k - 1) : first + 3 * k] = np.eye(3)
    if fixes:
        datum = np.asarray(g.values.datum).copy()
        datum[:2] += np.asarray(g.gps_origin)
        J[:, :, :3] = se2_adjoint(se2_inverse(poses))  # effect of a datum error on the node
        poses = se2_compose(np.broadcast_to(datum, poses.shape), poses)
    else:
        J, poses, true = J[1:], poses[1:], true[1:]
    error = se2_log(se2_between(poses, true))
    A = J.reshape(-1, len(at))
    return consistency(error, A @ P @ A.T)


def consistency(error: Array, covariance: Array) -> dict[str, float]:
    """NEES and RMS of errors ``(k, 3)`` with their joint covariance ``(3k, 3k)``."""
    k = len(error)
    white, L = [], np.zeros_like(covariance)
    for i in range(k):
        own = slice(3 * i, 3 * i + 3)
        L[own, own] = np.linalg.inv(np.linalg.cholesky(covariance[own, own]))
        white.append(L[own, own] @ error[i])
    C = L @ covariance @ L.T
    joint = error.ravel() @ np.linalg.solve(covariance + 1e-13 * np.eye(3 * k), error.ravel())
    return {
        "node": float(np.mean(np.square(white))),
        "node_dof": float((3 * k) ** 2 / np.sum(C**2)),
        "joint": float(joint / (3 * k)),
        "joint_dof": float(3 * k),
        "rms": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
    }


def verdict_without_truth(found: Run) -> int:
    """Verdict without ground truth, as an index into :data:`WORDS`."""
    figures = RunMetrics.of_rows(found.report, found.metric_rows, found.events)
    lines = [f for f in found.verdict if f.code not in ("headline", "nees")]
    return WORDS.index(run_verdict(lines, [], covariance_assessment(figures))[0])


def run_trial(w: World, seed: int) -> Iterator[Measurement]:
    """All metrics of one run (see the module)."""
    log = world_log(w, SeedTree(seed)) if isinstance(w, TrustWorld) else w.log(seed)
    yield Measurement("run", "clean", float(w.clean))
    try:
        found = run(log, seed=seed, progress=False)
    except GraphSlamError:
        yield Measurement("run", "verdict", float(WORDS.index("refused")))
        return
    for quantity, value in scored(found, log).items():
        yield Measurement("run", quantity, value)
    yield Measurement("run", "verdict", float(verdict_without_truth(found)))


class TrustStudy(WorldsStudy[World]):
    """See the module."""

    run_one = staticmethod(run_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``confusion``: true class by verdict; ``summary``: rates of wrong verdicts; ``worlds``."""
        known = {**self.full, **self.quick}
        worlds = world_table(table, known)
        return {"confusion": confusion_table(worlds, known), "summary": summary_table(worlds), "worlds": worlds}

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """NEES/n of all runs."""
        return draw_runs(table, {"joint": "NEES/n of all nodes"}, folder)


def world_table(table: pd.DataFrame, known: dict[str, World]) -> pd.DataFrame:
    """One row per world: its errors, NEES/n pooled over its runs, and the number of runs with each verdict.

    ``bad map``: NEES/n of the single nodes or of all jointly is above :data:`WRONG` and above its 97.5 % bound, because
    a mean over a dozen correlated errors of few runs may exceed 1.5 by chance.
    ``true``: verdict by ground truth: ``wrong`` above :data:`LARGE`; ``conservative`` if both are below 1/1.5 and below
    their 2.5 % bound.
    """
    out = []
    for world in table["world"].unique():
        own = table[table["world"] == world]
        figures = {q: whole(own, q)["value"].to_numpy() for q in ("node", "node_dof", "joint", "joint_dof", "verdict")}
        if not len(figures["verdict"]):
            continue
        row: dict[str, object] = {"world": world, "what is wrong": known[world].wrong, "gps": known[world].gps}
        bad, large, small = False, False, True
        for q in ("node", "joint"):
            dof = float(np.sum(figures[f"{q}_dof"]))
            mean = float(np.sum(figures[q] * figures[f"{q}_dof"]) / dof) if dof else np.nan
            low, high = stats.chi2.ppf([0.025, 0.975], dof) / dof if dof else (np.nan, np.nan)
            bad |= mean > max(WRONG, high)
            large |= mean > max(LARGE, high)
            small &= mean < min(1.0 / WRONG, low)
            row[q] = mean
        row["true"] = "wrong" if large else "overconfident" if bad else "conservative" if small else "consistent"
        if np.isnan(mean):
            row["true"] = "refused"
        row["bad map"], row["clean"] = bad, known[world].clean
        out.append(row | {verdict: int(np.sum(figures["verdict"] == k)) for k, verdict in enumerate(WORDS)})
    return pd.DataFrame(out)


def confusion_table(worlds: pd.DataFrame, known: dict[str, World]) -> pd.DataFrame:
    """True class (rows) by verdict (columns), for clean worlds, worlds with errors, and worlds with faults."""
    rows = []
    kind = [
        "clean" if known[w].clean else "fault" if isinstance(known[w], FaultWorld) else "error" for w in worlds["world"]
    ]
    for (name, true), own in worlds.groupby([pd.Series(kind, worlds.index), "true"]):
        rows.append({"worlds": name, "true": true, **{verdict: int(own[verdict].sum()) for verdict in WORDS}})
    return pd.DataFrame(rows)


def summary_table(worlds: pd.DataFrame) -> pd.DataFrame:
    """Verdicts in worlds with bad maps, in clean ones, and in the others; and the shares of wrong verdicts."""
    out = []
    for name, rows in (
        ("NEES/n > 1.5", worlds[worlds["bad map"]]),
        ("clean", worlds[worlds["clean"]]),
        ("other", worlds[~worlds["clean"] & ~worlds["bad map"]]),
    ):
        counts = {verdict: int(rows[verdict].sum()) for verdict in WORDS}
        runs = sum(counts.values())
        bad = counts["consistent"] + counts["conservative"]
        if name != "NEES/n > 1.5":
            bad = counts["overconfident"] + counts["wrong"]
        low, high = share_interval(bad, runs) if runs else (np.nan, np.nan)
        share = {"points the wrong way": bad / runs if runs and name != "other" else np.nan, "from": low, "to": high}
        out.append({"worlds are": name, "worlds": len(rows), "runs": runs, **counts, **share})
    return pd.DataFrame(out)


FULL: dict[str, World] = {f"world-{k:03d}": draw_world(k) for k in WORLDS_DRAWN}
FULL |= fault_worlds()
FULL |= {
    f"{kind}-{k}": ScanWorld(kind=kind, number=k) for kind in ("park", "laser", "garage", "lidar") for k in range(8)
}
QUICK: dict[str, World] = {f"quick-{k:02d}": draw_world(k, seconds=80.0) for k in (4, 9, 22, 31)}
STUDY = TrustStudy(
    "trust",
    "what a run without truth says of its covariances, beside what is true, in worlds that are drawn",
    FULL,
    QUICK,
    trials=1,
)
