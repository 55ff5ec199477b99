"""A made-up study table of known character, in the vocabulary of the study ``combined-slam``."""

from __future__ import annotations

import numpy as np
import pandas as pd

COLUMNS = ["world", "run", "algorithm", "submap", "quantity", "value"]

# algorithm -> how its NEES/n grows over the run (factor at the end), and its RMS scale
GROWTH = {
    "ekf": (500.0, 3.0),
    "rbpf": (1e9, 4.0),
    "ekf-eif": (60.0, 2.8),
    "rbpf-ekf": (70.0, 2.6),
    "rbpf-eif": (70.0, 2.6),
    "default-eif": (40.0, 2.7),
    "default-online": (1.0, 1.0),
}


def study_rows(
    *, runs: int = 20, submaps: int = 126, world: str = "A", seed: int = 0
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Table and timings: ``default-online`` is honest, the rest ever bolder along the run."""
    rng = np.random.default_rng(seed)
    rows: list[tuple] = []
    timed: list[tuple] = []
    k = np.arange(submaps)
    for run in range(runs):
        walk = np.cumsum(rng.normal(0, 1, (submaps, 3)), axis=0) / np.sqrt(k + 1)[:, None]
        for name, (growth, scale) in GROWTH.items():
            bold = np.exp(np.log(growth) * (k / submaps) ** 1.5)
            sigma = 0.1 * np.sqrt(k + 1) * np.array([[1.0], [1.2], [0.005]])
            error = walk.T * sigma * np.sqrt(bold)
            d2 = np.sum((error / sigma) ** 2, axis=0)
            rows += [(world, run, name, s, "pose_nees", d2[s]) for s in k]
            rows += [(world, run, name, s, "feature_nees", d2[s] * 2 / 3) for s in k[8::9]]
            for c, component in enumerate(("x", "y", "heading")):
                rows += [(world, run, name, s, f"error_{component}", error[c, s]) for s in k]
                rows += [(world, run, name, s, f"sigma_{component}", sigma[c, s]) for s in k]
            level = scale * rng.lognormal(0, 0.5)
            for quantity, factor in (("pose_rms", 14.0), ("heading_rms", 0.03), ("feature_rms", 15.0)):
                rows.append((world, run, name, -1, quantity, factor * level))
            cost = {"ekf": 4e-5, "rbpf-ekf": 6e-5}.get(name, 4e-6) * rng.lognormal(0, 0.1)
            timed += [(world, run, name, s, "seconds_cumulative", cost * (s + 1) ** 2) for s in k]
        timed.append((world, run, "rbpf-eif-tree", -1, "seconds_total", 0.02 * rng.lognormal(0, 0.1)))
        for name, scale in (("local-ekf", 1.05), ("local-paper", 1.2), ("local-default", 1.0)):
            n = 3 + 2 * rng.integers(6, 27, submaps)
            d2 = scale * rng.chisquare(n)
            rows += [(world, run, name, s, "local_joint_nees", d2[s]) for s in k]
            rows += [(world, run, name, s, "local_joint_dof", float(n[s])) for s in k]
    return pd.DataFrame(rows, columns=COLUMNS), pd.DataFrame(timed, columns=COLUMNS)
