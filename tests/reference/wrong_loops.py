"""Wrong loops added to a pose network: random ones, and perceptually aliased ones that agree with each other.

A wrong loop says what a real one would say (its relative pose and its information are those of a loop of the network),
but of two places that do not belong together. ``aliased`` loops come in groups: two stretches of the path are taken
for one and the same place, pose by pose, so the loops of a group are consistent with each other and only the rest of
the map contradicts them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import stats

from graphslam.core import geometry as se2
from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork

Index = npt.NDArray[np.intp]
Kind = Literal["random", "aliased"]
# A drawn loop that the reference poses do not contradict with this confidence is not wrong, and is drawn again.
CONTRADICTED = 1.0 - 1e-9
ATTEMPTS = 200


@dataclass(frozen=True, slots=True)
class WrongLoops:
    """A network with wrong loops in it.

    Parameters
    ----------
    network : PoseNetwork
        The edges of the original in their order, then the wrong ones.
    wrong : (m,) bool
        Which edges were added.
    group : (m,) int64
        Aliased loops of one group share a number; -1 for the original's edges, own number for random loops.
    """

    network: PoseNetwork
    wrong: npt.NDArray[np.bool_]
    group: npt.NDArray[np.int64]


def is_odometry(edges: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
    """Edges between neighbours in vertex order, ``(m,)``: everything else is a loop."""
    return np.asarray(np.abs(edges[:, 1] - edges[:, 0]) == 1)


def add_wrong_loops(
    network: PoseNetwork,
    share: float,
    rng: np.random.Generator,
    *,
    kind: Kind = "random",
    reference: npt.ArrayLike | None = None,
    group_size: int = 10,
) -> WrongLoops:
    """Add wrong loops until they are the given share of all loops.

    Parameters
    ----------
    network : PoseNetwork
        With at least one loop (:func:`is_odometry`); 2-D or 3-D. Landmark observations are left as they are.
    share : float
        Wrong loops among all loops afterwards, in [0, 1): 0.5 adds as many as there are.
    rng : numpy.random.Generator
        Of a :class:`~graphslam.core.random.SeedTree`.
    kind : {"random", "aliased"}
        Independent loops between random poses, or groups that agree with each other.
    reference : (n, 3) or (n, 7), optional
        Poses that say what is wrong: the solved network, or the truth; by default the network's own values. A loop
        that these poses do not contradict at 1 - 1e-9 (χ² of its own information) is drawn again, so that every loop
        that is called wrong is wrong. Without it the noise of aliased loops is drawn from their information instead.
    group_size : int
        Loops in a group of aliased ones.

    Returns
    -------
    WrongLoops

    Raises
    ------
    ConfigError
        Share or group size out of range, or an unknown kind.
    DataError
        No loop to imitate, no reference poses, or a network in which no wrong loop can be drawn (every pose is as
        good as at one place).
    """
    if not 0.0 <= share < 1.0:
        raise ConfigError(f"the share of wrong loops must lie in [0, 1), got {share}")
    if kind not in ("random", "aliased"):
        raise ConfigError(f"kind of wrong loops must be random or aliased, got {kind!r}")
    if group_size < 1:
        raise ConfigError(f"a group needs at least one loop, got {group_size}")
    loops = np.flatnonzero(~is_odometry(network.edges))
    if len(loops) == 0:
        raise DataError("no loop whose information a wrong one could have", where=network.source)
    if reference is None and not network.has_initial.all():
        raise DataError("wrong loops need reference poses: the network has none", where=network.source)
    poses = np.asarray(network.poses if reference is None else reference, dtype=np.float64)
    if poses.shape != network.poses.shape:
        raise DataError("reference poses do not fit", where=network.source, got=poses.shape, wanted=network.poses.shape)
    wanted = round(share / (1.0 - share) * len(loops))
    size = 1 if kind == "random" else min(group_size, max(len(network) // 4, 1))
    limit = float(stats.chi2.ppf(CONTRADICTED, network.tangent_dim))
    edges: list[Index] = []
    like: list[Index] = []
    measured: list[Array] = []
    group: list[Index] = []
    have, groups, failed = 0, 0, 0
    while have < wanted:
        n = min(size, wanted - have)
        # many groups at a time: almost all of them stand
        count = -(-(wanted - have) // n) if n == size else 1
        ends, model, z = _draw(network, poses, loops, count, n, rng, reference is not None)
        good = (_costs(network, poses, ends, model, z) > limit).reshape(count, n).all(axis=1)
        good &= (np.abs(ends[:, 1] - ends[:, 0]) > 1).reshape(count, n).all(axis=1)
        failed = 0 if good.any() else failed + 1
        if failed > ATTEMPTS:
            raise DataError(
                "no wrong loop can be drawn: the reference poses contradict none",
                where=network.source,
                got=f"{have} of {wanted} loops",
                wanted="poses that are apart by more than the loops' uncertainty",
            )
        keep = np.repeat(good, n)
        edges.append(ends[keep])
        like.append(model[keep])
        measured.append(z[keep])
        group.append(np.repeat(groups + np.arange(good.sum()), n))
        groups += int(good.sum())
        have += int(keep.sum())
    m = len(network.edges)
    none = np.zeros((0,), dtype=np.intp)
    copied = np.concatenate([none, *like]).astype(np.intp)
    mixed = replace(
        network,
        edges=np.concatenate([network.edges, *edges]),
        measurements=np.concatenate([network.measurements, *measured]),
        information=np.concatenate([network.information, network.information[copied]]),
        source=f"{network.source} with {have} wrong loops",
    )
    return WrongLoops(
        mixed,
        np.arange(m + have) >= m,
        np.concatenate([np.full(m, -1), *group]).astype(np.int64),
    )


def _draw(
    network: PoseNetwork,
    poses: Array,
    loops: Index,
    count: int,
    size: int,
    rng: np.random.Generator,
    solved: bool,
) -> tuple[Index, Index, Array]:
    """Ends ``(count · size, 2)``, the loop that each imitates, and the measurement of each.

    A group takes the stretches ``a … a+size`` and ``b … b+size`` for one place: one motion W of the second, which puts
    b where a loop of the network would see it from a, makes all measurements ``x_{a+k}⁻¹ W x_{b+k}``. A single loop is
    a group of one: its measurement is that of the loop which it imitates. In a group all but the first are disturbed
    by what the loops which they imitate are off themselves (files often overstate their noise: groups as noisy as
    they say would not agree with each other as real loops do).
    """
    n = len(network)
    first = rng.integers(0, n - size + 1, size=(count, 2))
    model = rng.choice(loops, size=(count, size))
    z0 = network.measurements[model[:, 0]]
    if size == 1:
        return first, model[:, 0], z0
    compose, between, exp = (
        (se2.se2_compose, se2.se2_between, se2.se2_exp)
        if network.dim == 2
        else (se3.se3_compose, se3.se3_between, se3.se3_exp)
    )
    # W = x_a z0 x_b⁻¹, so W x_{b+k} = (x_a z0) (x_b⁻¹ x_{b+k})
    step = np.arange(size)
    along_a, along_b = poses[first[:, :1] + step], poses[first[:, 1:] + step]
    moved = compose(compose(poses[first[:, 0]], z0)[:, None], between(poses[first[:, 1]][:, None], along_b))
    z = between(along_a, moved).reshape(count * size, -1)
    model = model.reshape(-1)
    i, j = network.edges[model].T
    log = se2.se2_log if network.dim == 2 else se3.se3_log
    noise = log(between(network.measurements[model], between(poses[i], poses[j])))
    if not solved:
        w, V = np.linalg.eigh(network.information[model])
        known = w > 1e-12 * w.max(axis=1, keepdims=True)
        sigma = np.where(known, 1.0 / np.sqrt(np.where(known, w, 1.0)), 0.0)
        noise = np.einsum("kij,kj->ki", V, sigma * rng.standard_normal(w.shape))
    noise.reshape(count, size, -1)[:, 0] = 0.0
    ends = (first[:, None, :] + step[:, None]).reshape(count * size, 2)
    return ends, model, compose(z, exp(noise))


def _costs(network: PoseNetwork, poses: Array, ends: Index, model: Index, z: Array) -> Array:
    if network.dim == 2:
        r = se2.se2_log(se2.se2_between(z, se2.se2_between(poses[ends[:, 0]], poses[ends[:, 1]])))
    else:
        r = se3.se3_log(se3.se3_between(z, se3.se3_between(poses[ends[:, 0]], poses[ends[:, 1]])))
    return np.asarray(np.einsum("ki,kij,kj->k", r, network.information[model], r))
