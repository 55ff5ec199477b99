"""Undetermined variables of a pose network, reported with the names of the file before solving.

GTSAM's LM "succeeds" on an undetermined network (because of its damping), and its other solvers report one key. Here
all are reported, with what would fix it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphslam.core.errors import IndeterminateError
from graphslam.core.network import PoseNetwork
from graphslam.graph.diagnose import null_variables, unconnected_variables
from graphslam.graph.factor_arrays import FactorArrays
from graphslam.graph.factors.batch import UniformBatch
from graphslam.graph.variables import Values, split_name


def check_determined(network: PoseNetwork, flat: FactorArrays) -> None:
    """Raise if a vertex or landmark is not connected to an anchor by measurements."""
    lost, islands = unconnected_variables(flat)
    if lost:
        names = _in_words(network, lost)
        raise IndeterminateError(
            f"{network.source}: {_list(names)} {'are' if len(names) > 1 else 'is'} not connected to "
            f"vertex {network.ids[network.anchors[0]]} ({islands} separate part{'s' if islands > 1 else ''}); each "
            "part needs an edge to the rest, or a FIX of one of its vertices",
            names,
        )


def check_full_rank(network: PoseNetwork, flat: FactorArrays, values: Values) -> None:
    """Raise if measurements with rank-deficient information leave a direction free.

    No cost if every information matrix has full rank.
    """
    pivots = (np.diagonal(f.whiteners, axis1=1, axis2=2) for f in flat.batches if isinstance(f, UniformBatch))
    if all((np.abs(p) > 1e-12 * np.abs(p).max(axis=1, keepdims=True)).all() for p in pivots):
        return
    lost = null_variables(flat.evaluate(values).A, flat.layout)
    if lost:
        names = _in_words(network, lost)
        raise IndeterminateError(
            f"{network.source}: measurements with singular information leave {_list(names)} free in some direction; "
            "give an edge there information in every direction, add another edge, or a FIX",
            names,
        )


def _in_words(network: PoseNetwork, names: Sequence[str]) -> tuple[str, ...]:
    """Names of variables as in the file, in its order."""
    parts = sorted((kind.word == "l", k) for kind, k in map(split_name, names))
    return tuple(f"landmark {k}" if mark else f"vertex {network.ids[k]}" for mark, k in parts)


def _list(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - 5} more" if len(names) > 5 else ""
    return ", ".join(names[:5]) + more
