"""The study ``trust``: the word of a verdict that knows no ground truth, beside what is true.

Worlds are drawn: robots among landmarks (:mod:`graphslam_studies.trust_worlds`: route, landmarks, robot, noise,
receiver), and robots with scans (:class:`ScanWorld`: a park with a building, garages, lidars). Half of the landmark
worlds are as stated; the others have one or two errors that are not stated, or a fault of ``docs/faults.md``
(:mod:`graphslam_studies.trust_faults`). ``graphslam.run`` maps each with its default options: front end, calibration,
refinement and loop closures are chosen as for a newcomer's log.

Among landmarks the score has nothing in common with what it judges: it is made here of the simulator's poses and the
covariances that the graph reports. With fixes poses are scored in the frame of the fixes, else in that of the first
base.

Quantities
----------
``node``: NEES of the nodes, each by itself, over its dimension, mean; ``node_dof``: the degrees of freedom of this mean
(errors of nodes are correlated: ``n² / ‖C‖²``); ``joint``, ``joint_dof``: NEES/n of all nodes together; ``rms`` of
of their positions [m]; ``word``: index into :data:`WORDS`, alone where the log is refused; ``clean``. Worlds with
scans are scored by the run's own NEES of its nodes or of its refined path (``nees_per_dof``), as ``joint`` and
``node``.
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
from graphslam.app.run.summary import verdict_word
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
"""Of a verdict; the last: there is no map."""
WRONG = 1.5
"""NEES/n from which on a map must not be called consistent or conservative."""
LARGE = 9.0
"""NEES/n from which on a map is wrong: errors of three standard deviations on average."""
WORLDS_DRAWN = range(800, 860)
"""Worlds of the study. Of those before some were looked at while rules and defaults were made: they judge no more."""


@dataclass(frozen=True, kw_only=True)
class ScanWorld:
    """A world with scans in which everything is as stated.

    Parameters
    ----------
    kind : {"park", "laser", "garage", "lidar"}
        Landmarks and a planar laser in a building and a park around it; the laser alone; a panning laser in a drawn
        garage; a drawn lidar.
    number : int
        Of the place, the robot and its noise, together with the seed of a run.
    seconds : float
        Of the log, at most [s].
    """

    kind: str
    number: int
    seconds: float = 120.0
    clean: bool = True
    wrong: str = "nothing"
    gps: str = "none"

    def log(self, seed: int) -> SensorLog:
        """A log of the world; no preset is known by its name."""
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
    """Errors of the nodes against the simulator, by what the graph reports of them."""
    if found.graph is None or found.graph.dim == 3:
        value = found.metrics.set_index("key")["value"]
        joint, dof = float(value.get("nees_per_dof", np.nan)), float(value.get("nees_dof", np.nan))
        return {"node": joint, "node_dof": dof, "joint": joint, "joint_dof": dof, "rms": float(value["path_rmse"])}
    return _scored_in_plane(found, log)


def _scored_in_plane(found: Run, log: SensorLog) -> dict[str, float]:
    """Errors of all nodes against the simulator, by what the graph claims of them."""
    g = found.graph
    assert g is not None
    nodes = np.array([s.node for s in g.submaps] + [g.submaps[-1].exit_node])
    times = np.array([s.interval[0] for s in g.submaps] + [g.submaps[-1].interval[1]])
    assert log.truth is not None
    known = log.truth.trajectory.times
    times = np.clip(times, known[0], known[-1])  # a clock that was corrected moves the ends of the log
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
        J[:, :, :3] = se2_adjoint(se2_inverse(poses))  # an error of the datum, carried to the node
        poses = se2_compose(np.broadcast_to(datum, poses.shape), poses)
    else:
        J, poses, true = J[1:], poses[1:], true[1:]
    error = se2_log(se2_between(poses, true))
    A = J.reshape(-1, len(at))
    return honesty(error, A @ P @ A.T)


def honesty(error: Array, covariance: Array) -> dict[str, float]:
    """Figures of errors ``(k, 3)`` with their joint covariance ``(3k, 3k)``."""
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


def word_without_truth(found: Run) -> int:
    """The word of a verdict that does not know the ground truth, as a number into :data:`WORDS`."""
    figures = RunMetrics.of_table(found.report, found.metrics, found.events)
    lines = [f for f in found.verdict if f.code not in ("headline", "nees")]
    return WORDS.index(verdict_word(lines, [], covariance_assessment(figures))[0])


def run_trial(w: World, seed: int) -> Iterator[Measurement]:
    """All figures of one run (see the module)."""
    log = world_log(w, SeedTree(seed)) if isinstance(w, TrustWorld) else w.log(seed)
    yield Measurement("run", "clean", float(w.clean))
    try:
        found = run(log, seed=seed, progress=False)
    except GraphSlamError:
        yield Measurement("run", "word", float(WORDS.index("refused")))
        return
    for quantity, value in scored(found, log).items():
        yield Measurement("run", quantity, value)
    yield Measurement("run", "word", float(word_without_truth(found)))


class TrustStudy(WorldsStudy[World]):
    """See the module."""

    run_one = staticmethod(run_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``confusion``: truth against words; ``summary``: is it ever green where it must not be; ``worlds``."""
        known = {**self.full, **self.quick}
        worlds = world_table(table, known)
        return {"confusion": confusion_table(worlds, known), "summary": summary_table(worlds), "worlds": worlds}

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Honesty of all runs."""
        return draw_runs(table, {"joint": "NEES/n of all nodes"}, folder)


def world_table(table: pd.DataFrame, known: dict[str, World]) -> pd.DataFrame:
    """A row a world: what is wrong with it, NEES/n pooled over its runs, and how often each word was said.

    ``bad map`` where the nodes, each by itself or all together, have more than :data:`WRONG`, and more than chance
    explains (97.5 %): a mean over a dozen correlated errors of few runs is above 1.5 now and then.
    ``true`` is what a verdict that knew the truth would say: ``wrong`` from :data:`LARGE` on, ``conservative`` where
    both are below 1/1.5, and below chance.
    """
    out = []
    for world in table["world"].unique():
        own = table[table["world"] == world]
        figures = {q: whole(own, q)["value"].to_numpy() for q in ("node", "node_dof", "joint", "joint_dof", "word")}
        if not len(figures["word"]):
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
        out.append(row | {word: int(np.sum(figures["word"] == k)) for k, word in enumerate(WORDS)})
    return pd.DataFrame(out)


def confusion_table(worlds: pd.DataFrame, known: dict[str, World]) -> pd.DataFrame:
    """What is true (rows) against what was said (columns), of clean worlds, of those with errors, and with faults."""
    rows = []
    kind = [
        "clean" if known[w].clean else "fault" if isinstance(known[w], FaultWorld) else "error" for w in worlds["world"]
    ]
    for (name, true), own in worlds.groupby([pd.Series(kind, worlds.index), "true"]):
        rows.append({"worlds": name, "true": true, **{word: int(own[word].sum()) for word in WORDS}})
    return pd.DataFrame(rows)


def summary_table(worlds: pd.DataFrame) -> pd.DataFrame:
    """How often which word was said of wrong worlds, of clean ones, and of the rest; and the shares that count."""
    out = []
    for name, rows in (
        ("NEES/n > 1.5", worlds[worlds["bad map"]]),
        ("clean", worlds[worlds["clean"]]),
        ("other", worlds[~worlds["clean"] & ~worlds["bad map"]]),
    ):
        counts = {word: int(rows[word].sum()) for word in WORDS}
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
