"""Options that once were, and the value that each has now.

A configuration that states one at that value is read as before, so that run folders and TOML files written when it was
an option stay good; another value is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from graphslam.core.errors import ConfigError

LOCALISATION = {
    **{"particles": 100, "rounds": 4, "position": 0.4, "angle": 0.05},
    **{"effective_beams": 60.0, "cast_sigma": 0.2, "clip": 3.0},
}
PASSED = {"heading": 0.6, "position": 0.75, "height_tilt": 110.0}
DRIFT = {
    **{"dim": 3, "position_start": 0.028, "position_walk": 0.0, "position_scale": 0.0093},
    **{"z_start": 0.026, "z_walk": 0.0, "z_scale": 0.0024},
    **{"heading_start": 0.0095, "heading_walk": 0.005, "heading_scale": 0.0, "tilt": 0.006, "bend": 0.22},
}
SURFACE = {
    **{"radius": 0.8, "spacing": 0.1, "neighbours": 12, "thickness": 0.06, "flatness": 0.15, "extent": 0.045},
}
VOXEL = {"miss": 0.4, "clamp": [0.1192, 0.971]}

REMOVED: dict[str, dict[str, Any]] = {
    "BackEndConfig": {"merge_reach": 5.0, "loop_overlap": 8.0, "loop_height": 1.0},
    "CandidateSearch": {"max_yaw": 0.8, "least_score": 0.7, "score_margin": 0.15, "cloud_level": 1, "same_start": 1.0},
    "ChoiceConfig": {
        **{"vague_position": 0.4, "vague_angle": 0.04, "rivals": 0.15, "mode_distance": 1.5},
        **{"fitness_sigma": 0.15, "error_sigma": 0.4, "spread_sigma": 0.3},
    },
    "DeadReckoningNoise": {
        **{"filter_time": 5.0, "gap_speed": 0.5, "gap_rate": 0.3, "gap_tilt": 0.1, "floor_angle": 1e-5},
    },
    "EkfFilterConfig": {"control_hold": 0.5, "active_margin": 20.0},
    "FilterConfig": {
        **{"control_hold": 0.5, "delayed": {"min_ranges": 5, "spread": 0.1, "margin": 16.0, "support": 0.9}},
    },
    "FilterDrift": {
        **{"heading_start": 0.002, "position_start": 0.01, "height_start": 0.025, "height_scale": 0.002},
        "passed": PASSED,
    },
    "GridFilterConfig": {
        **{**VOXEL, "cast_effective_beams": 4.0, "greatest_exponent": 1.0, "interpolation": "trilinear"},
        **{"cast_sigma": 0.2, "cast_clip": 3.0, "cast_beams": 60},
    },
    "HandoverConfig": {"minimum_support": 0.05},
    "LidarOdometryConfig": {"most_kept": 8000, "finest_sigma": 0.05, "window_scans": 100, "suspicious": 0.7},
    "LidarSubmapConfig": {**VOXEL, "most_scans": 100},
    "PointsConfig": {"max_landmarks": 60},
    "RbpfGridConfig": {"drift": DRIFT, "passed": PASSED},
    "RefineConfig": {
        **{"chunk_length": 3.0, "chunk_time": 10.0, "chunk_turn": 0.5, "knot": 30.0},
        "surface": SURFACE,
    },
    "RegistrationConfig": {"rotation_epsilon": 1e-4, "translation_epsilon": 1e-4, "covariance_scale_planar": 5.0},
    "ScanWindowConfig": {
        **{"normal_sigma": 0.03, "least_overlap": 0.1, "most_spread": 0.15, "surprise": 40.0, "surface": SURFACE},
    },
    "SegSlamConfig": {"localisation": LOCALISATION},
    "SegmentationConfig": {
        **{"score_sigma": 0.3, "score_beams": 600, "score_particles": 8},
        **{"known_score": 0.8, "known_radius": 2.0, "known_gap": 20.0},
    },
    "StepConfig": {"cloud_range": 60.0, "odometry_tilt_time": 10.0},
    "TreeDetectorConfig": {
        **{"break_distance": 1.5, "max_missing": 5, "max_depth": 0.5, "isolation": 3.0, "occlusion": 0.3},
        **{"min_beams": 1, "fit_beams": 5, "beam_sigma": 0.03},
    },
    "WindowSubmapConfig": VOXEL,
}
"""Class of the configuration → key → fixed value, as in TOML."""


def is_removed(kind: type, key: str, value: Any, name: str) -> bool:
    """Was ``key`` of ``kind`` an option, and does ``value`` say what is done now? ``name`` is for messages."""
    fixed = next((REMOVED[k.__name__] for k in kind.__mro__ if key in REMOVED.get(k.__name__, {})), None)
    if fixed is None:
        return False
    if wrong := _differs(value, fixed[key], name):
        raise ConfigError(wrong)
    return True


def _differs(value: Any, fixed: Any, name: str) -> str:
    """What to say of a value other than the fixed one; of a table that states some of the keys, those count."""
    if isinstance(fixed, Mapping) and isinstance(value, Mapping):
        return next((_differs(v, fixed.get(k), f"{name}.{k}") for k, v in value.items() if v != fixed.get(k)), "")
    same = list(value) == fixed if isinstance(value, (list, tuple)) else value == fixed
    return "" if same else f"{name} = {value!r}: this option was removed, its value is always {fixed!r}; leave it out"
