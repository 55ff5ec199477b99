"""A whole study in seconds: the quick landmark field, submaps, two solvers, every figure against the truth."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
import pandas as pd

from graphslam.app.run.pipeline import run
from graphslam.app.worlds import simulate
from graphslam.core.gaussian import chi2_quantile
from graphslam.evaluate.consistency import nees, pose_error
from graphslam_studies.evaluate.submap_consistency import submap_nees
from graphslam_studies.evaluate.tables import summarise
from graphslam_studies.montecarlo.trials import Measurement, trial_seed

# sensor noise of each world: range [m], bearing [rad]
WORLDS = {"near": (0.2, 0.035), "fine": (0.1, 0.017)}
FRONT_END = {"association": "known", "particles": 10}


def small_trial(seed: int, *, noise: tuple[float, float], laps: float) -> Iterator[Measurement]:
    """One drive through the quick field: pose and landmark errors of two solvers on the same submaps."""
    log = simulate(
        "landmark-field", preset="quick", seed=seed % 2**32, sigma_range=noise[0], sigma_bearing=noise[1], laps=laps
    )
    assert log.truth is not None
    for solver in ("batch", "isam2"):
        begin = perf_counter()
        found = run(log, solver=solver, seed=seed % 2**32, config={"frontend": FRONT_END}, progress=False)
        yield Measurement(solver, "seconds_total", perf_counter() - begin, timing=True)
        m = found.map
        truth = log.truth.trajectory.interpolate(m.node_times)
        error = pose_error(m.node_poses, truth)  # along and across the estimate, as its covariances are
        d2 = nees(error[1:], m.node_covariances[1:])
        for k in range(len(d2)):
            yield Measurement(solver, "pose_nees", float(d2[k]), k)
            for c, name in enumerate(("x", "y", "heading")):
                yield Measurement(solver, f"error_{name}", float(error[k + 1, c]), k)
                yield Measurement(solver, f"sigma_{name}", float(np.sqrt(m.node_covariances[k + 1, c, c])), k)
            yield Measurement(
                solver, "seconds_cumulative", (perf_counter() - begin) * (k + 1) / len(d2), k, timing=True
            )
        order = np.searchsorted(log.truth.landmark_ids, m.landmark_ids)
        off = np.linalg.norm(m.landmarks - log.truth.landmarks[order], axis=1)
        yield Measurement(solver, "feature_rms", float(np.sqrt(np.mean(off**2))))
        yield Measurement(solver, "heading_rms", float(np.sqrt(np.mean(error[:, 2] ** 2))))
        yield Measurement(solver, "pose_rms", float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))))
    for s in found.submaps:
        local = submap_nees(s, log.truth)
        yield Measurement("local-default", "local_joint_nees", local.joint, s.key)
        yield Measurement("local-default", "local_joint_dof", float(local.joint_dof), s.key)
        yield Measurement(
            "local-default", "local_inside", float(local.joint < chi2_quantile(0.95, local.joint_dof)), s.key
        )


def fragile_trial(seed: int, *, raises: int, dies: int) -> Iterable[Measurement]:
    """A trial that raises for one seed, kills its own process for another, and gives one number for the rest."""
    if seed == raises:
        raise ValueError("no | convergence")
    if seed == dies:
        os.kill(os.getpid(), signal.SIGKILL)
    return [Measurement("a", "q", float(np.random.default_rng(seed).normal()))]


@dataclass(frozen=True)
class SmallStudy:
    """Two worlds of the quick field."""

    name: str = "small"
    description: str = "The quick landmark field with two sensors."
    laps: float = 1.3

    def worlds(self, quick: bool) -> tuple[str, ...]:
        return tuple(WORLDS)[: 1 if quick else 2]

    def default_trials(self, quick: bool) -> int:
        return 2 if quick else 4

    def trial(self, world: str, quick: bool) -> Callable[[int], Iterable[Measurement]]:
        return partial(small_trial, noise=WORLDS[world], laps=self.laps)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        whole = table[table["submap"] == -1]
        return {f"World {w}": summarise(rows) for w, rows in whole.groupby("world")}

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        from graphslam.plots.save import save_figure
        from graphslam_studies.plots.study import plot_ci

        return [
            save_figure(plot_ci(None, rows, "pose_nees"), folder / f"ci-{w}.png") for w, rows in table.groupby("world")
        ]


@dataclass(frozen=True)
class FragileStudy(SmallStudy):
    """Trial 1 raises, trial 2 kills its process."""

    name: str = "fragile"

    def worlds(self, quick: bool) -> tuple[str, ...]:
        return ("one",)

    def trial(self, world: str, quick: bool) -> Callable[[int], Iterable[Measurement]]:
        return partial(fragile_trial, raises=trial_seed(0, 1), dies=-1 if quick else trial_seed(0, 2))

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        return []


STUDY = SmallStudy()
LONGER = SmallStudy(laps=1.4)
FRAGILE = FragileStudy()
