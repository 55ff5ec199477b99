"""The study ``surface``: how well several ways find the surface of a simulated world again.

Every run carries a lidar along the first stretch of a world, with errors of ranges and of the pose of each scan, and
makes surfaces of the same scans with voxels of 5 cm:

* ``level-set λ``: distances to local planes, carving, curvature of weight λ;
* ``planes, no carving``: the data alone;
* ``ray tsdf``: a truncated signed distance along the beams, in the same bricks;
* ``log-odds``: marching cubes on an evidence grid;
* ``poisson``: Open3D's screened Poisson surface, without what lies farther than three voxels from every point.

Quantities
----------
``f_5cm``, ``f_2cm``: harmonic mean of the share of the surface within that of the true one, and of the seen part of the
true one within that of it. ``mean_mm``: mean distance to the true surface. ``area_ratio``: area over that of the seen
part. ``bricks_per_m2``, ``kb_per_m2``: of the layer. ``follow_same``: 1 if the surface after a move of a tenth of the
pieces is bit for bit the one made anew. Timings: ``seconds``, ``us_per_point``, ``us_per_m2`` (of evolving and
meshing), ``follow_over_rebuild`` (to what it takes from scans).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import pandas as pd

from graphslam_studies.montecarlo.trials import Measurement
from graphslam_studies.montecarlo.worlds_study import WorldsStudy
from graphslam_studies.sim.lidar import LidarConfig
from graphslam_studies.surface_trial import SurfaceTrialConfig, run_surface_trial

WORLDS = {
    "garage": SurfaceTrialConfig(world="garage"),
    "campus": SurfaceTrialConfig(world="campus"),
    "garage-short": SurfaceTrialConfig(world="garage", seconds=5.0, smoothings=(0.1,), beside=False),
    "garage-long": SurfaceTrialConfig(world="garage", seconds=20.0, smoothings=(0.1,), beside=False),
}
_FEW = LidarConfig(rate=2.0, points=6_000, lines=64, elevation=(-45.0, 45.0))
QUICK_WORLDS = {"quick": SurfaceTrialConfig(world="garage", voxel=0.1, seconds=3.0, smoothings=(0.1,), lidar=_FEW)}
SHOWN = (
    *("f_5cm", "f_2cm", "precision_5cm", "recall_5cm", "mean_mm", "area_ratio", "seen_m2", "bricks_per_m2"),
    *("kb_per_m2", "moved_share", "follow_same"),
)


class SurfaceStudy(WorldsStudy[SurfaceTrialConfig]):
    """Surfaces against the truth."""

    run_one: Callable[[SurfaceTrialConfig, int], Iterable[Measurement]] = staticmethod(run_surface_trial)

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`."""
        out: dict[str, pd.DataFrame] = {}
        for world, rows in table.groupby("world", sort=False):
            wide = rows.pivot_table(index="algorithm", columns="quantity", values="value", sort=False)
            out[f"{world}: means of {rows['run'].nunique()} runs"] = wide[[q for q in SHOWN if q in wide]].reset_index()
        if len(timings):
            cost = timings.pivot_table(index=["world", "algorithm"], columns="quantity", values="value", sort=False)
            out["CPU time"] = cost.reset_index()
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`; the tables say it all."""
        return []


STUDY = SurfaceStudy(
    "surface",
    "Surfaces of a simulated world: level set, truncated distance, log-odds and Poisson beside ground truth.",
    WORLDS,
    QUICK_WORLDS,
    trials=3,
)
