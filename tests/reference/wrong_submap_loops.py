"""Wrong loops between places of a chain of submaps, for tests and studies of what decides on loops.

They have passed every gate of their registration, and say so. ``random``: two places that do not belong together, with
the relative pose and the covariance of a right loop. ``shifted``: a right loop moved along the aisle by the period of
its pillars, and its neighbours with it, so that a group agrees with itself. ``swapped``: a stretch taken for another
one, a parallel gallery, place by place; these agree with each other too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import stats

from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of, heading_of
from graphslam.loops.measure import Loop

Kind = Literal["random", "shifted", "swapped"]
KINDS: tuple[Kind, ...] = ("random", "shifted", "swapped")
CONTRADICTED = 0.999
"""A loop is wrong if the true poses contradict it with this confidence; one that they do not is drawn again."""
ATTEMPTS = 1000


def inject_wrong_loops(
    loops: Sequence[Loop],
    poses: npt.ArrayLike,
    share: float,
    rng: np.random.Generator,
    *,
    kind: Kind = "random",
    period: float = 8.0,
    group_size: int = 3,
) -> tuple[list[Loop], npt.NDArray[np.bool_]]:
    """Wrong loops among right ones.

    Parameters
    ----------
    loops : sequence of Loop
        Right ones, whose covariances and relative poses are imitated.
    poses : (n, 7) or (n, 3)
        True poses of all places.
    share : float
        Of wrong loops among all, in [0, 1).
    rng : numpy.random.Generator
    kind : {"random", "shifted", "swapped"}
    period : float
        Of the pillars: what ``shifted`` loops are off by [m].
    group_size : int
        Loops of a group of shifted or swapped ones.

    Returns
    -------
    loops : list of Loop
        All, in random order.
    wrong : (m,) bool
        Which were added.

    Raises
    ------
    ConfigError, DataError
        A share or kind out of range; no loop to imitate; no wrong loop can be drawn.
    """
    x = np.asarray(poses, dtype=np.float64)
    if not 0.0 <= share < 1.0 or kind not in KINDS or group_size < 1 or not period > 0:
        raise ConfigError(f"wrong loops: share {share}, kind {kind!r}, group {group_size}, period {period}")
    if not loops:
        raise DataError("no right loop that a wrong one could be like")
    wanted, made = round(share / (1.0 - share) * len(loops)), list[Loop]()
    for _ in range(ATTEMPTS):
        if len(made) >= wanted:
            break
        like = loops[int(rng.integers(len(loops)))]
        size = 1 if kind == "random" else group_size
        group = _draw(kind, like, x, size, period, rng)
        made += [w for w in group if _contradicted(w, x)][: wanted - len(made)]
    else:
        raise DataError("no wrong loop can be drawn: the true poses contradict none", got=f"{len(made)} of {wanted}")
    both = [*loops, *made]
    wrong = np.arange(len(both)) >= len(loops)
    order = rng.permutation(len(both))
    return [both[k] for k in order], wrong[order]


def _draw(kind: Kind, like: Loop, x: Array, size: int, period: float, rng: np.random.Generator) -> list[Loop]:
    g, n = group_of(x), len(x)
    if kind == "random":
        i, j = sorted(rng.choice(n, 2, replace=False).tolist())
        return [replace(like, i=i, j=j, gates={}, why="")]
    step = np.arange(size)
    if kind == "shifted":
        i, j = like.i, like.j
        # a retraced stretch runs the same way or back
        same = np.cos(heading_of(x[i]) - heading_of(x[j])) > 0
        ends = np.stack([i + (step if same else -step), j + step], 1)
        ahead = heading_of(x[i])
        W = g.identity.copy()
        W[:2] = rng.choice([-1.0, 1.0]) * period * np.array([np.cos(ahead), np.sin(ahead)])
        moved = g.compose(W, x[np.clip(ends[:, 1], 0, n - 1)])
    else:
        a, b = rng.integers(0, n - size + 1, 2).tolist()
        ends = np.stack([a + step, b + step], 1)
        # one motion of the second stretch puts its first place where the right loop would see it
        W = g.compose(g.compose(x[a], like.T_ij), g.inverse(x[b]))
        moved = g.compose(W, x[ends[:, 1]])
    out = []
    L = np.linalg.cholesky(like.covariance)
    for (i, j), T_j in zip(ends.tolist(), moved):
        if not (0 <= i < n and 0 <= j < n) or i == j:
            continue
        T = g.compose(g.between(x[i], T_j), g.exp(L @ rng.standard_normal(g.dof)))
        out.append(replace(like, i=i, j=j, T_ij=T, gates={}, why=""))
    return out


def _contradicted(w: Loop, x: Array) -> bool:
    g = group_of(x)
    e = g.log(g.between(g.between(x[w.i], x[w.j]), w.T_ij))
    return float(e @ np.linalg.solve(w.covariance, e)) > float(stats.chi2.ppf(CONTRADICTED, g.dof))
