"""Errors and consistency of a refined path against ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from graphslam.core.geometry import Array
from graphslam.core.map_truth import MapTruth
from graphslam.core.poses import group_of, heading_of, remove_roll_pitch
from graphslam.core.submap import Submap
from graphslam.core.trajectory import Trajectory
from graphslam.evaluate.metrics import Metrics, end_metrics, match_ids
from graphslam.maps.global_map import GlobalMap
from graphslam.maps.refined import steps_at
from graphslam.refine.result import Refinement


def level_truth(
    truth: MapTruth, path: Trajectory | None, true_base: Array, refined: Trajectory
) -> tuple[MapTruth, Trajectory | None]:
    """Ground truth in the frame of a refined path: level, with the first position and heading of that path.

    Parameters
    ----------
    truth : MapTruth
        In the frame of the first base.
    path : Trajectory or None
        True path in that frame.
    true_base : (7,) or (3,)
        Of the first submap, in a gravity-aligned frame.
    refined : Trajectory
        Its first position and heading are fixed. If their true values are unknown, those of the first base are aligned.
    """
    g = group_of(true_base)
    if g.dim == 2:
        return truth, path
    T = g.between(remove_roll_pitch(true_base), true_base)
    if path is not None and path.times[0] == refined.times[0]:  # the base lies below the body, by an estimated tilt
        begin = remove_roll_pitch(g.compose(T, path.poses[0]))
        T = g.compose(g.compose(remove_roll_pitch(refined.poses[0]), g.inverse(begin)), T)
    moved = replace(truth, exit_poses=g.compose(np.broadcast_to(T, truth.exit_poses.shape), truth.exit_poses))
    if path is not None:
        path = Trajectory(path.times, g.compose(np.broadcast_to(T, path.poses.shape), path.poses))
    return moved, path


def refined_truth_metrics(
    out: Metrics,
    m: GlobalMap,
    refinement: Refinement,
    submaps: Sequence[Submap],
    truth: MapTruth,
    *,
    path: Trajectory | None = None,
) -> None:
    """RMSE and NEES of the ends of the submaps on the refined path, and errors of the path.

    Parameters
    ----------
    m : GlobalMap
        With the refined nodes.
    truth : MapTruth
        Gravity-aligned (:func:`level_truth`), as ``path``.
    path : Trajectory, optional
        True path at full rate.
    """
    i, j = match_ids(np.array([s.key for s in submaps], np.int64), truth.keys)
    poses = m.base_poses[1:][i]
    steps = steps_at(refinement, m.base_times[1:][i])
    g = group_of(poses)
    ad = g.adjoint(g.between(poses, refinement.poses[steps]))  # tangent of the body → of the step's pose
    # several submaps that end at one step share its covariance
    P = refinement.joint(steps).reshape(len(steps), g.dof, len(steps), g.dof)
    P = np.einsum("iab,ibjc,jdc->iajd", ad, P, ad).reshape(len(steps) * g.dof, -1)
    end_metrics(out, poses, P, truth.exit_poses[j], m.trajectory, path)


def heading_error(estimate: Trajectory, truth: Trajectory) -> float:
    """RMS of the heading along a path after its mean is taken out [rad]."""
    inside = (truth.times >= estimate.times[0]) & (truth.times <= estimate.times[-1])
    h = heading_of(estimate.interpolate(truth.times[inside])) - heading_of(truth.poses[inside])
    mean = np.angle(np.mean(np.exp(1j * h)))
    return float(np.sqrt(np.mean(np.angle(np.exp(1j * (h - mean))) ** 2)))


def refinement_metrics(out: Metrics, r: Refinement) -> None:
    """Metrics of a refinement."""
    last = r.rounds[-1]
    out.add("refine_pairs", last.pairs)
    out.add("refine_pairs_passes", last.passes)
    out.add("refine_spread", last.spread, "m", "lower")
    out.add("refine_agreement", r.agreement[1], "", "higher")
    out.add("refine_agreement_graph", r.agreement[0])
    out.add("refine_agreement_odometry", r.reckoned)
    out.add("refine_alike", r.alike, "", "one")
    out.add("refine_left_apart", len(r.refused))
    out.add("refine_motion_chi2_per_dof", r.motion, "", "one")
    if r.fixes is not None:
        out.add("refine_fixes", r.fixes.used)
        out.add("refine_fixes_rms", r.fixes.rms, "m", "lower")
    bias = r.yaw_bias[:, 1]
    out.add("refine_yaw_bias", float(np.mean(bias)), "rad/s")
    for name, unit in (("scale", ""), ("side", "rad"), ("rise", "rad"), ("clock", "s")):
        if name in r.constants:
            out.add(f"refine_{name}", r.constants[name][0], unit)
            out.add(f"refine_{name}_sigma", r.constants[name][1], unit)


def refinement_facts(r: Refinement) -> dict[str, Any]:
    """Entries of a refinement in ``run.json``: rounds, constants with σ, yaw bias over time."""
    return {
        "rounds": [asdict(x) for x in r.rounds],
        "agreement": list(r.agreement),
        "agreement_odometry": r.reckoned,
        "constants": {name: {"value": v, "sigma": s} for name, (v, s) in r.constants.items()},
        "yaw_bias": r.yaw_bias.tolist(),
        "motion_chi2_per_dof": r.motion,
        "alike": r.alike,
        "left_apart": r.times[r.refused].tolist() if len(r.refused) else [],
        "fixes": None if (f := r.fixes) is None else {**asdict(f), "T_gps_world": f.T_gps_world.tolist()},
    }
