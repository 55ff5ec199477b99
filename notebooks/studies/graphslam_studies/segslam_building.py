"""The study ``segslam-building``: map entropy in a building with corridors on three levels, driven out and back.

Worlds: ``building``, ``building-drawn`` (random layout); clutter and sensor errors are random in each run. Algorithms:
``dead-reckoning``, ``rbpf-N``, ``segslam-40``. The study ``building-particles`` runs the RBPF with 200, 400 and 800
particles in the same runs.

Quantities, besides path errors and times
-----------------------------------------
``entropy_min``: minimum entropy [nat m³] (SegSLAM eq. 20–22) over at most 20 hypotheses of a run: map samples of
SegSLAM, or distinct particle paths of an RBPF, the best particle first. For each, all scans are inserted into four maps
with 0.2 m voxels and different placements of the lattice. The mean entropy is used, because the position of floors in
their voxels changes it by ± 70 nat m³. ``entropy``: that of the first hypothesis; ``entropy_samples``: number of
hypotheses. ``known_volume``: observed volume of the map with the least entropy [m³]. Entropy is a sum over observed
voxels, so it is too small if levels of a map overlap: compare ``height_rmse`` [m]. ``leg_angle``: RMS error of the
angles between straight path sections on different levels [rad].
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd

from graphslam_frontends.segslam.config import SegmentationConfig, SegSlamConfig
from graphslam_studies import segslam_report as tables
from graphslam_studies.montecarlo.worlds_study import draw_runs
from graphslam_studies.segslam_garage import path_figure
from graphslam_studies.segslam_trial import DEAD_RECKONING, LEVEL, QUICK, Figure, GridStudy, GridTrialConfig

_FIGURES: tuple[Figure, ...] = ("matches", "entropy", "legs", "path")
_ALGORITHMS = (DEAD_RECKONING, "rbpf-20", "rbpf-40", "rbpf-100", "segslam-40")
# Twice the default length, so that segments end in rooms and halls more often than in a corridor, and the way back is
# in the same map as the way out. Chosen in worlds that the study does not use.
SEGSLAM = SegSlamConfig(segmentation=SegmentationConfig(max_length=120.0))
_BUILDING = GridTrialConfig(
    world="building",
    algorithms=_ALGORITHMS,
    figures=_FIGURES,
    samples=20,
    placements=4,
    segslam=SEGSLAM,
    steps=LEVEL,
)
PARTICLE_WORLDS = {f"building-{n}": replace(_BUILDING, algorithms=(f"rbpf-{n}",)) for n in (200, 400, 800)}
"""Worlds with one number of particles each, so that trials are short; the runs are those of ``building``."""
WORLDS = {"building": _BUILDING, "building-drawn": replace(_BUILDING, layout="drawn")}
QUICK_WORLDS = {
    "court-quick": replace(
        QUICK, algorithms=(DEAD_RECKONING, "rbpf-5", "segslam-5"), figures=_FIGURES, samples=3, placements=2
    ),
}
DRAWN = {"entropy_min": "least entropy [nat m³]", "ate_aligned": "ATE, aligned [m]", "leg_angle": "angle of legs [rad]"}


class SegSlamBuilding(GridStudy):
    """See the module."""

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """``entropies``, ``paths``, ``matches``, ``seconds`` by part."""
        champion = "segslam-40" if (table["algorithm"] == "segslam-40").any() else "segslam-5"
        out = {"entropies": tables.entropy_table(table, champion)}
        quantities = (
            "entropy_min",
            "final_error",
            "ate_anchored",
            "ate_aligned",
            "height_rmse",
            "leg_angle",
            "known_volume",
            "maps_megabytes",
        )
        out["paths"] = tables.means_table(table, quantities)
        out["matches"] = tables.match_table(table)
        if not timings.empty:
            out["seconds"] = tables.seconds_table(timings)
        return out

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Entropies, errors and angles of all runs; the path of one run by segments."""
        made = draw_runs(table, DRAWN, folder)
        for world in dict.fromkeys(table["world"].astype(str)):
            made += path_figure(table, world, folder)
        return made


STUDY = SegSlamBuilding(
    "segslam-building",
    "three levels of out-and-back corridors: least map entropy over samples, path and angles of RBPF and SegSLAM",
    WORLDS,
    QUICK_WORLDS,
)
PARTICLES = SegSlamBuilding(
    "building-particles",
    "the building with more particles of the RBPF, up to 800 as in the paper: least map entropy, path and angles",
    PARTICLE_WORLDS,
    QUICK_WORLDS,
    trials=3,
)
