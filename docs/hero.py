"""The picture of the first page: ``python docs/hero.py`` writes ``docs/images/hero.png``.

Left: map, path and 95 % ellipses of a simulated drive. Right: NEES per degree of freedom of every pose, with the
two-sided bounds of a single pose.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import graphslam as gs
from graphslam.evaluate.path_consistency import path_consistency
from graphslam.evaluate.residual_consistency import two_sided_bounds

OUT = Path(__file__).parent / "images" / "hero.png"


def main() -> None:
    """Simulate, run, draw."""
    log = gs.simulate("landmark-field", preset="demo", seed=1)
    run = gs.run(log, seed=1, progress=False)
    gs.plots.use_palette()
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), width_ratios=(1.15, 1), layout="constrained")
    run.plot(left)
    assert log.truth is not None
    assert log.truth.trajectory is not None
    path = run.map.trajectory
    found = path_consistency(path, log.truth.trajectory, chart="group")
    ratio = found.nees / found.dof
    low, high, _ = two_sided_bounds(1.0, found.dof, 0.95)
    right.axhspan(low, high, color="0.9", label="95 % bounds of one pose")
    right.axhline(1.0, color="0.4", lw=1, ls="--", label="expected")
    right.plot(path.times[found.rows] - path.times[0], ratio, lw=1.2, label="this run")
    right.set(xlabel="time [s]", ylabel="NEES / degrees of freedom", ylim=(0.0, 1.25 * high))
    right.set_title("are the errors as large as the ellipses?")
    right.legend(loc="upper right", fontsize=8)
    figure.savefig(OUT, dpi=110)
    inside = float(np.mean((ratio > low) & (ratio < high)))
    print(f"{OUT.name}: {100 * inside:.0f} % of the poses inside the bounds; verdict: {run.verdict}")


if __name__ == "__main__":
    main()
