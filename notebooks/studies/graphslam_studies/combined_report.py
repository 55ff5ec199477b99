"""Tables of the Combined SLAM study, computed from its tidy table.

The run is the statistical unit, because errors within a run are correlated through its heading. Means depend strongly
on the worst run, so medians are given too; bounds are two-sided at 95 %.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from graphslam.core.gaussian import chi2_mean_bounds, chi2_quantile
from graphslam.core.geometry import Array

_POSE, _FEATURE = chi2_quantile(0.95, 3), chi2_quantile(0.95, 2)
GLOBAL = (
    *("ekf", "rbpf", "ekf-eif", "ekf-eif-tree", "rbpf-ekf", "rbpf-eif", "rbpf-eif-tree"),
    *("default-ekf", "default-eif-classical", "default-eif-tree-classical", "default-eif", "default-eif-tree"),
    *("ekf-eif+polish", "rbpf-eif+polish", "default-eif+polish", "default-isam2", "default-online", "default-optimum"),
    "full-batch",
)
LOCAL = ("local-default", "local-ekf", "local-paper", "local-paper-1.0", "local-paper-inflated")
JOINT_TARGET = {"A": (0.0, 1.05), "B": (0.0, 1.20), "C": (0.95, 1.02)}
"""Target interval of the joint feature NEES/n of the default maps at their optimum."""


def final(world: pd.DataFrame, algorithm: str, quantity: str) -> Array:
    """Values ``(runs,)`` of a metric of whole runs, in order of run."""
    rows = world[(world["algorithm"] == algorithm) & (world["quantity"] == quantity) & (world["submap"] < 0)]
    return rows.sort_values("run")["value"].to_numpy(dtype=np.float64)


def online(world: pd.DataFrame, algorithm: str, quantity: str) -> pd.DataFrame:
    """Values after each submap, as runs × submaps."""
    rows = world[(world["algorithm"] == algorithm) & (world["quantity"] == quantity) & (world["submap"] >= 0)]
    return rows.pivot(index="run", columns="submap", values="value")


def _worlds(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    for name in dict.fromkeys(table["world"]):
        yield str(name), table[table["world"] == name]


def mean_bounds(dof: float, units: int) -> tuple[float, float]:
    """Two-sided 95 % bounds of the mean of ``units`` independent NEES/dof."""
    low, high = chi2_mean_bounds(dof, units)
    return low / dof, high / dof


def local_maps(table: pd.DataFrame) -> pd.DataFrame:
    """Consistency of local maps; each map is a unit, because the maps of a run use different data."""
    rows = []
    for world, t in _worlds(table):
        for name in LOCAL:
            joint = online(t, name, "local_joint_nees").to_numpy()
            if not joint.size:
                continue
            dof = online(t, name, "local_joint_dof").to_numpy()
            pose = online(t, name, "local_pose_nees").to_numpy()
            n = int(np.isfinite(joint).sum())
            low, high = chi2_mean_bounds(float(np.nansum(dof)), 1)
            le, he = mean_bounds(3, n)
            ess = online(t, name, "min_ess").to_numpy()
            rows.append(
                {
                    "world": world,
                    "maps": name,
                    "number": n,
                    "joint NEES/n": np.nansum(joint) / np.nansum(dof),
                    "joint bounds": f"[{low / np.nansum(dof):.3f}, {high / np.nansum(dof):.3f}]",
                    "pose NEES/3": np.nanmean(pose) / 3,
                    "pose bounds": f"[{le:.3f}, {he:.3f}]",
                    "feature NEES/2": np.nanmean(online(t, name, "local_feature_nees").to_numpy()) / 2,
                    "inside 95 %": np.nanmean(online(t, name, "local_inside").to_numpy()),
                    "features": np.nanmean(online(t, name, "local_features").to_numpy()),
                    "least N_eff": np.nanmean(ess) if ess.size else np.nan,
                }
            )
    return pd.DataFrame(rows)


def global_maps(table: pd.DataFrame) -> pd.DataFrame:
    """Accuracy and consistency of whole maps at the end of the run."""
    rows = []
    for world, t in _worlds(table):
        for name in GLOBAL:
            feature = final(t, name, "feature_nees") / _FEATURE
            diverged = final(t, name, "diverged")
            if not diverged.size:
                continue
            row: dict[str, Any] = {
                "world": world,
                "algorithm": name,
                "runs": len(diverged),
                "diverged": int(diverged.sum()),
            }
            if feature.size:
                pose = final(t, name, "pose_nees") / _POSE
                n = final(t, name, "feature_joint_dof")
                row |= {
                    "pose CI mean": pose.mean(),
                    "pose CI median": np.median(pose),
                    "feature CI mean": feature.mean(),
                    "feature CI median": np.median(feature),
                    "joint feature NEES/n": final(t, name, "feature_joint_nees").sum() / n.sum(),
                    "map NEES/n": _by_dof(t, name, "map_nees"),
                    "map NEES/n, plain": _by_dof(t, name, "map_nees_plain"),
                    "features inside 95 %": final(t, name, "feature_inside").mean(),
                    "feature RMS m": final(t, name, "feature_rms").mean(),
                    "pose RMS m": final(t, name, "pose_rms").mean(),
                    "heading RMS deg": np.rad2deg(final(t, name, "heading_rms").mean()),
                }
            rows.append(row)
    return pd.DataFrame(rows)


def _by_dof(world: pd.DataFrame, algorithm: str, quantity: str) -> float:
    """Value per degree of freedom of whole maps, pooled over runs; NaN if a method has no joint Gaussian of its map."""
    value, dof = (final(world, algorithm, q) for q in (quantity, "map_dof"))
    return float(value.sum() / dof.sum()) if value.size else np.nan


def online_consistency(table: pd.DataFrame, quantity: str = "pose_nees") -> pd.DataFrame:
    """Mean pose CI along the run compared with the two-sided bounds of a mean over the runs.

    Parameters
    ----------
    quantity : str
        ``pose_nees``, or ``pose_nees_tangent``: the same covariance, with the error as a right perturbation.
    """
    rows = []
    for world, t in _worlds(table):
        for name in GLOBAL:
            nees = online(t, name, quantity).to_numpy()
            if not nees.size:
                continue
            ci = np.nanmean(nees, axis=0) / _POSE
            low, high = (3 * b / _POSE for b in mean_bounds(3, nees.shape[0]))
            inside = (ci >= low) & (ci <= high)
            near = (ci >= 0.9 * low) & (ci <= 1.1 * high)
            quarters = np.array_split(ci, 9)
            above = np.flatnonzero(ci > 1.0)
            above_median = np.flatnonzero(np.nanmedian(nees, axis=0) / _POSE > 1.0)
            rows.append(
                {
                    "world": world,
                    "algorithm": name,
                    "bounds": f"[{low:.2f}, {high:.2f}]",
                    "first ninth": quarters[0].mean(),
                    "before closure": quarters[3].mean(),
                    "at closure": quarters[4].mean(),
                    "last ninth": quarters[8].mean(),
                    "final": ci[-1],
                    "least": ci.min(),
                    "greatest": ci.max(),
                    "inside": inside.mean(),
                    "inside or within 10 %": near.mean(),
                    "mean CI passes 1 at": int(above[0]) + 1 if len(above) else None,
                    "median CI passes 1 at": int(above_median[0]) + 1 if len(above_median) else None,
                }
            )
    return pd.DataFrame(rows)


def paired(table: pd.DataFrame) -> pd.DataFrame:
    """Paired comparison of algorithms, run by run."""
    pairs = (
        *(("rbpf", "ekf"), ("ekf-eif", "ekf"), ("rbpf-eif", "rbpf"), ("rbpf-eif", "ekf"), ("rbpf-eif", "ekf-eif")),
        *(("default-eif-tree", "default-eif-tree-classical"), ("default-eif", "default-eif-classical")),
        *(("rbpf-eif-tree", "rbpf-eif"), ("ekf-eif-tree", "ekf-eif"), ("default-eif-tree", "default-eif")),
        *(("rbpf-eif+polish", "rbpf-eif"), ("default-eif+polish", "default-eif"), ("default-eif+polish", "rbpf-eif")),
        *(("default-eif+polish", "ekf-eif"), ("default-eif+polish", "ekf-eif+polish")),
        *(("rbpf-eif+polish", "ekf-eif+polish"), ("default-eif+polish", "full-batch")),
    )
    rows = []
    for world, t in _worlds(table):
        for a, b in pairs:
            for quantity in ("feature_nees", "feature_joint_nees", "feature_rms", "pose_nees", "map_nees"):
                x, y = _common(t, a, b, quantity)
                if len(x) < 2:
                    continue
                ratio = x / y
                logs = np.log(ratio)
                rows.append(
                    {
                        "world": world,
                        "a": a,
                        "b": b,
                        "quantity": quantity,
                        "geometric mean a/b": np.exp(logs.mean()),
                        "× or ÷": np.exp(1.96 * logs.std(ddof=1) / np.sqrt(len(logs))),
                        "median": np.median(ratio),
                        "a smaller in": int(np.sum(ratio < 1)),
                        "runs": len(ratio),
                    }
                )
    return pd.DataFrame(rows)


def _common(t: pd.DataFrame, a: str, b: str, quantity: str) -> tuple[Array, Array]:
    rows = t[(t["quantity"] == quantity) & (t["submap"] < 0) & t["algorithm"].isin([a, b])]
    wide = rows.pivot(index="run", columns="algorithm", values="value")
    if a not in wide or b not in wide:
        return np.zeros(0), np.zeros(0)
    wide = wide[[a, b]].dropna()
    return wide[a].to_numpy(), wide[b].to_numpy()


def agreement(table: pd.DataFrame) -> pd.DataFrame:
    """Whether all least-squares methods reach the same objective, and whether EKF join equals sequential EIF."""
    rows = []
    for world, t in _worlds(table):
        every = {a: final(t, a, "objective_optimum") for a in sorted(set(t["algorithm"])) if a.startswith("default")}
        every = {a: v for a, v in every.items() if v.size}
        spread = np.ptp(np.array(list(every.values())), axis=0) / every["default-batch"]
        dof = final(t, "default-batch", "objective_dof")
        whole, whole_dof = final(t, "full-batch", "objective"), final(t, "full-batch", "objective_dof")
        rows.append(
            {
                "world": world,
                "methods": ", ".join(every),
                "greatest relative difference": spread.max(),
                "EKF join - sequential EIF, default maps [m, rad]": final(t, "default-ekf", "difference_to_eif").max(),
                "the same, paper maps": final(t, "rbpf-ekf", "difference_to_eif").max(initial=0.0),
                "join χ²/dof": every["default-batch"].sum() / dof.sum(),
                "full batch χ²/dof": whole.sum() / whole_dof.sum(),
                "polish steps from tree": final(t, "default-eif+polish", "polish_iterations").max(),
            }
        )
    return pd.DataFrame(rows)


def targets(table: pd.DataFrame) -> pd.DataFrame:
    """Targets for the default method, and whether they are met."""
    rows: list[dict[str, Any]] = []

    def add(world: str, what: str, value: float, low: float, high: float) -> None:
        rows.append({"world": world, "target": what, "value": value, "wanted": f"[{low:.3g}, {high:.3g}]",
                     "met": bool(low <= value <= high)})  # fmt: skip

    ratios: list[Array] = []
    for world, t in _worlds(table):
        joint, dof = (online(t, "local-default", q).to_numpy() for q in ("local_joint_nees", "local_joint_dof"))
        pose = online(t, "local-default", "local_pose_nees").to_numpy()
        add(world, "local maps: joint NEES/n", joint.sum() / dof.sum(), 0.97, 1.03)
        add(world, "local maps: pose NEES/3", pose.mean() / 3, 0.92, 1.08)
        add(world, "local maps: inside 95 %", online(t, "local-default", "local_inside").to_numpy().mean(), 0.93, 1.0)
        best = "default-eif+polish"
        n = final(t, best, "feature_joint_dof").sum()
        low, high = JOINT_TARGET.get(world, (0.9, 1.1))
        add(world, "optimum: joint feature NEES/n", final(t, best, "feature_joint_nees").sum() / n, low, high)
        runs = len(final(t, best, "pose_nees"))
        low, high = (3 * b / _POSE for b in mean_bounds(3, runs))
        add(world, "optimum: mean pose CI, final", final(t, best, "pose_nees").mean() / _POSE, 0.9 * low, 1.1 * high)
        for name in ("default-optimum", "default-online"):
            ci = online(t, name, "pose_nees").to_numpy().mean(axis=0) / _POSE
            add(world, f"{name}: mean pose CI, least over submaps", ci.min(), 0.9 * low, 1.1 * high)
            add(world, f"{name}: mean pose CI, greatest over submaps", ci.max(), 0.9 * low, 1.1 * high)
        x, y = _common(t, best, "full-batch", "feature_rms")
        rms = float(np.sqrt(np.mean(x**2)) / np.sqrt(np.mean(y**2))) if len(x) else np.nan
        add(world, "optimum: feature RMS / full batch", rms, 0.0, 1.05)
        if world in ("A", "B"):
            x, y = _common(t, "default-eif-classical", best, "feature_nees")
            ratios.append(np.log(x / y))
            add(
                world,
                "classical sequential EIF / optimum in feature NEES",
                float(np.exp(ratios[-1].mean())),
                10.0,
                np.inf,
            )
    if ratios:
        together = float(np.exp(np.concatenate(ratios).mean()))
        add("A, B", "classical sequential EIF / optimum in feature NEES", together, 10.0, np.inf)
    return pd.DataFrame(rows)


def joining_times(timings: pd.DataFrame) -> pd.DataFrame:
    """Median time over runs by part [s], as in Table 1. Other trials ran in parallel, so it is only indicative."""
    rows = timings[(timings["submap"] < 0) & timings["quantity"].str.startswith("seconds_")]
    wide = rows.pivot_table(index=["world", "algorithm"], columns="quantity", values="value", aggfunc="median")
    return wide.reset_index()


def report(table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """All tables by title."""
    return {
        "Targets of the defaults": targets(table),
        "Local maps": local_maps(table),
        "Whole maps at the end": global_maps(table),
        "Pose CI along the run": online_consistency(table),
        "Pose CI along the run, error as a right perturbation": online_consistency(table, "pose_nees_tangent"),
        "Run by run": paired(table),
        "Agreement": agreement(table),
        "Seconds": joining_times(timings),
    }
