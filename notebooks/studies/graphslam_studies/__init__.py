"""Registered studies, looked up lazily: a name, and the ``module:object`` that defines it."""

from __future__ import annotations

STUDIES: dict[str, str] = {
    "charts": "graphslam.app.studies.charts:STUDY",
    "combined-slam": "graphslam.app.studies.combined_slam:STUDY",
    "association-ambiguity": "graphslam.app.studies.association_ambiguity:STUDY",
    "segslam-garage": "graphslam.app.studies.segslam_garage:STUDY",
    "segslam-mine": "graphslam.app.studies.segslam_mine:STUDY",
    "segslam-building": "graphslam.app.studies.segslam_building:STUDY",
    "segmap-graph": "graphslam.app.studies.segmap_graph:STUDY",
    "campus": "graphslam.app.studies.campus:STUDY",
    "refinement": "graphslam.app.studies.refinement:STUDY",
    "exits": "graphslam.app.studies.exits:STUDY",
    "heights": "graphslam.app.studies.heights:STUDY",
    "calibration": "graphslam.app.studies.calibration:STUDY",
    "scale": "graphslam.app.studies.scale:STUDY",
    "smartloc": "graphslam.app.studies.smartloc:STUDY",
    "surface": "graphslam.app.studies.surface:STUDY",
    "terrain": "graphslam.app.studies.terrain:STUDY",
    "trust": "graphslam.app.studies.trust:STUDY",
    "terrain-drives": "graphslam.app.studies.terrain_drives:STUDY",
    "withheld-fixes": "graphslam.app.studies.withheld_fixes:STUDY",
}
