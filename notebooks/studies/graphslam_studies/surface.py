"""The study ``surface``: comparison of methods for surface reconstruction in simulated worlds.

Every run moves a lidar along the first part of a world, with errors of ranges and scan poses, and reconstructs surfaces
from the same scans with voxels of 5 cm:

* ``level-set λ``: distances to local planes, free-space carving, curvature term with weight λ;
* ``planes, no carving``: distances to local planes only;
* ``ray tsdf``: a truncated signed distance along the beams, in the same bricks;
* ``log-odds``: marching cubes on an evidence grid;
* ``poisson``: screened Poisson surface of Open3D, without parts farther than three voxels from every point.

Quantities
----------
``f_5cm``, ``f_2cm``: F-score, i.e. harmonic mean of precision (share of the surface within this distance of the true
surface) and recall (share of the observed true surface within it of the result). ``mean_mm``: mean distance to the true
surface. ``area_ratio``: area over that of the observed part. ``bricks_per_m2``, ``kb_per_m2``: of the layer.
``follow_same``: 1 if the updated surface after a move of a tenth of the pieces is identical to a rebuilt one. Timings:
``seconds``, ``us_per_point``, ``us_per_m2``, ``follow_over_rebuild`` (update time over reconstruction time).
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
    """Reconstructed surfaces compared with ground truth."""

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
        """See :class:`~graphslam_studies.montecarlo.definition.StudyDefinition`; no plots."""
        return []


STUDY = SurfaceStudy(
    "surface",
    "Surfaces of a simulated world: level set, truncated distance, log-odds and Poisson beside ground truth.",
    WORLDS,
    QUICK_WORLDS,
    trials=3,
)
