"""The study ``combined-slam``: all algorithms of the Combined SLAM paper, and the defaults, on the same data.

Algorithms
----------
``ekf``, ``rbpf``: single-map filters. ``ekf-eif``, ``ekf-eif-tree``: EKF local maps joined by the information filter in
sequence or by binary tree. ``rbpf-ekf``, ``rbpf-eif``, ``rbpf-eif-tree``: moment-matched particle maps (as in the
paper), joined by EKF, EIF in sequence (SS), EIF by tree (BS). ``default-…``: the same with the default, smoothed
maps, in the group chart; ``…-classical``: joined as in the paper.
``…+polish``: the least-squares optimum of those maps. ``default-isam2``; ``default-online``: sequence with
relinearisation at loop closures; ``default-optimum``: relinearised at every submap. ``full-batch``: without submaps.
``local-…``: the local maps only.

Quantities
----------
After submap k ≥ 0: ``pose_nees`` (3 degrees of freedom; of the vector x, y, θ as in the paper) and
``pose_nees_tangent`` (of the right perturbation ``Log(T_est⁻¹ T_true)``), ``error_*``, ``sigma_*``, and, after every
ninth, ``feature_nees`` (mean over features, 2 degrees of freedom each) and ``feature_rms``. At the end (submap -1):
``pose_nees``, ``feature_nees``, ``feature_inside``, ``feature_joint_nees`` with ``feature_joint_dof``, ``feature_rms``,
``feature_median_error``, ``pose_rms``, ``heading_rms`` [rad], ``objective`` and ``objective_optimum``, ``diverged``; of
joined maps ``map_nees`` (all end poses and features jointly, in the group chart), ``map_nees_plain`` (as plain vector)
and ``map_dof``.
Of local map k: ``local_joint_nees`` with ``local_joint_dof``, ``local_pose_nees``, ``local_inside``, …
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import pandas as pd

from graphslam.core.errors import UnknownNameError
from graphslam.plots.save import save_figure
from graphslam_studies.combined_report import report
from graphslam_studies.combined_trial import TrialConfig, run_trial
from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.plots.study_figures import save_paper_figures
from graphslam_studies.plots.study_growth import plot_growth_panels

# Scans per submap, chosen for 126 submaps as in the paper: 35.4 m in A and C, 44.4 m in B.
_WORLDS = {"A": TrialConfig("A", 59), "B": TrialConfig("B", 74), "C": TrialConfig("C", 59)}
_QUICK = {"quick": TrialConfig("quick", 20)}

_GROWTH = ("ekf", "rbpf", "ekf-eif", "rbpf-eif", "default-eif", "default-online")


class CombinedSlam:
    """See the module."""

    name = "combined-slam"
    description = "EKF, RBPF, EKF-EIF, RBPF-EKF, RBPF-EIF (sequence, tree) beside iSAM2 and batch: NEES, CI, RMSE, time"

    def worlds(self, quick: bool) -> tuple[str, ...]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        return tuple(_QUICK if quick else _WORLDS)

    def default_trials(self, quick: bool) -> int:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        return 3 if quick else 20

    def trial(self, world: str, quick: bool) -> Callable[[int], Iterable[Measurement]]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        known = {**_WORLDS, **_QUICK}
        if world not in known:
            raise UnknownNameError("world of combined-slam", world, known)
        return partial(run_trial, known[world])

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        return report(table, timings)

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        made = save_paper_figures(table, timings, folder)
        for world in dict.fromkeys(table["world"]):
            t = table[table["world"] == world]
            there = set(t.loc[t["quantity"] == "error_x", "algorithm"])
            axes = plot_growth_panels(t, algorithms=[a for a in _GROWTH if a in there])
            made.append(save_figure(axes[0], folder / f"fig7-growth-{world}.png"))
        return made


STUDY = CombinedSlam()
