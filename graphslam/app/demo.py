"""The first thing a newcomer sees: a simulated drive, a map with ellipses, and every joiner on the same submaps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from graphslam.app.compare import compare, methods_json
from graphslam.app.pipeline import run
from graphslam.app.run import Run
from graphslam.app.run_folder import RunFolder
from graphslam.app.submap_sources import submap_source
from graphslam.app.worlds import simulate
from graphslam.core.gaussian import chi2_mean_bounds
from graphslam.evaluate.submap_consistency import submaps_consistency
from graphslam.plots.comparison import plot_comparison
from graphslam.plots.consistency import plot_consistency
from graphslam.plots.save import save


def run_demo(out: Path, *, seed: int = 1, preset: str = "demo", progress: bool = True) -> tuple[Run, pd.DataFrame]:
    """Simulate, run, compare, draw. Idempotent: a demo folder of the same seed and preset is gone on with.

    Returns
    -------
    run : Run
    comparison : DataFrame
        One row a method.
    """
    log = simulate("landmark-field", seed=seed, preset=preset)
    result = run(log, out=out, seed=seed, resume=True, progress=progress)
    source = submap_source(result)
    comparison = compare(source.submaps, truth=source.truth, progress=progress)
    folder = RunFolder(out)
    folder.write_json("compare.json", methods_json(comparison))
    save(comparison_figure(comparison), folder.figures / "compare.png")
    save(submap_honesty_figure(result), folder.figures / "consistency.png")
    return result, comparison


def comparison_figure(comparison: pd.DataFrame) -> Any:
    """NEES per degree of freedom of every method before polishing, beside the two-sided bounds of an honest map."""
    own = comparison["nees_unpolished"].fillna(comparison["nees"])
    dof = int(comparison["nees_dof"].iloc[0])
    low, high = chi2_mean_bounds(dof, 1)
    return plot_comparison(
        None,
        comparison.assign(nees_per_dof=own / comparison["nees_dof"]),
        "nees_per_dof",
        reference=(1.0, "honest"),
        band=(low / dof, high / dof, "95 % bounds, one run"),
        label="NEES / dof of poses and landmarks, before any polish",
        title="The same submaps joined five ways",
    )


def submap_honesty_figure(result: Run) -> Any:
    """NEES of every submap's joint Gaussian over exit and landmarks, each submap against its own truth."""
    assert result.log is not None
    assert result.log.truth is not None
    found = submaps_consistency(result.submaps, result.log.truth)
    keys = np.array([s.key + 1 for s in result.submaps])
    curves = {"exit and landmarks": found["joint"]}
    return plot_consistency(None, curves, submaps=keys, title="Is every submap honest on its own?")
