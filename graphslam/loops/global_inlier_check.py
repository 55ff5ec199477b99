"""Joint inlier test of all loops of a chain by truncated least squares, independent of their order.

Sequential decisions can fail together: several groups of loops that are wrong by the same motion support each other,
and once they are accepted, every correct loop there is rejected. In a joint test
(:mod:`graphslam.solve.network.robust`), each of these groups must fit the chain.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from graphslam.core.geometry import Array
from graphslam.core.network import PoseNetwork
from graphslam.core.poses import compose_increments, group_of
from graphslam.solve.network.robust import truncated_least_squares
from graphslam.solve.network.start import network_arrays

LEVEL = 0.9999


def truncated_least_squares_inliers(
    increments: Array,
    covariances: Array,
    loops: tuple[npt.NDArray[np.int64], Array, Array],
    level: float = LEVEL,
) -> npt.NDArray[np.bool_]:
    """Inliers among the loops, given the chain and the other loops.

    Parameters
    ----------
    increments : (n, 7|3)
        From node k to node k + 1.
    covariances : (n, d, d)
        Of their right tangents.
    loops : tuple
        Ends ``(l, 2)``, relative poses ``T_ij (l, 7|3)``, covariances of their right tangents ``(l, d, d)``.
    level : float
        Probability that a correct loop is kept, if the covariances are consistent.

    Returns
    -------
    (l,) bool
        Loops between neighbouring nodes are not tested, and True.
    """
    g = group_of(increments)
    ends = np.asarray(loops[0], dtype=np.intp).reshape(-1, 2)
    asked = np.abs(ends[:, 1] - ends[:, 0]) > 1
    out = np.ones(len(ends), dtype=np.bool_)
    if not asked.any():
        return out
    poses = compose_increments(increments)
    n = len(poses)
    steps = np.arange(n - 1)
    network = PoseNetwork(
        dim=g.dim,
        ids=np.arange(n),
        poses=poses,
        has_initial=np.ones(n, dtype=np.bool_),
        edges=np.concatenate([np.stack([steps, steps + 1], 1), ends[asked]]).astype(np.intp),
        measurements=np.concatenate([increments, loops[1][asked]]),
        information=np.linalg.inv(np.concatenate([covariances, loops[2][asked]])),
        source="chain of submaps with loops",
    )
    robust = truncated_least_squares(network, network_arrays(network), None, level, noise_scale=1.0)
    out[asked] = robust.inliers[n - 1 :]
    return out
