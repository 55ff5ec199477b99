"""File format of a graph of submaps: an archive of arrays with all values and the fields of all factors, by type.

Every field of a factor type is a column. ``columns`` lists their types. Only registered factor types are read; no code
of the file is executed or imported.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import scipy.sparse as sp

from graphslam.core.atomic import read_npz
from graphslam.core.errors import ConfigError, FormatError, GraphSlamError
from graphslam.graph.factor_graph import FactorGraph
from graphslam.graph.factors.batch import FactorRecord, factor_kinds
from graphslam.graph.factors.function import FunctionRecord
from graphslam.graph.noise import RobustKernel
from graphslam.graph.variables import KINDS, Values
from graphslam.linear.space_maps import SpaceMap

GRAPH_FORMAT = "graphslam.graph/1"
PARTS = ("keys", "bases", "times", "chains", "offset")
_NESTED: dict[str, type] = {"SpaceMap": SpaceMap}
"""Field types that are records."""


def graph_arrays(graph: FactorGraph, parts: Mapping[str, Any]) -> dict[str, Any]:
    """All arrays of a graph of submaps.

    Parameters
    ----------
    parts : mapping of str to array
        Those of :data:`PARTS`, of a :class:`~graphslam.join.graph_problem.JoinProblem`.
    """
    values, factors = graph.values, list(graph.records.values())
    own = [r.label() for r in factors if isinstance(r, FunctionRecord)]
    if own:
        raise ConfigError(f"a file cannot hold the function of {own[0]}; remove it from the graph")
    out: dict[str, Any] = {"format": GRAPH_FORMAT, "dim": values.dim, "landmark_ids": values.landmark_ids}
    out |= {f"values.{w}": values[w] for w in KINDS if values.count(w)}
    out |= {name: parts[name] for name in PARTS}
    columns: list[str] = []
    for batch in factor_kinds():
        records = [r for r in factors if type(r) is batch.record]
        if records:
            _write_fields(batch.record.__name__, records, out, columns)
    out["order"] = np.array([r.factor_id for r in factors], dtype=np.int64)
    out["columns"] = np.array(columns, dtype=str)
    return out


def _write_fields(name: str, records: Sequence[Any], out: dict[str, Any], columns: list[str]) -> None:
    for f in fields(records[0]):
        if f.init:
            _write(f"{name}.{f.name}", [getattr(r, f.name) for r in records], out, columns)


def _write(name: str, values: list[Any], out: dict[str, Any], columns: list[str]) -> None:
    """Write one column; ``NAME.have`` marks the values that are not None."""
    have = np.array([v is not None for v in values], dtype=bool)
    some = [v for v in values if v is not None]
    if not have.all():
        out[f"{name}.have"] = have
    first = some[0] if some else 0
    if isinstance(first, RobustKernel):
        kind = "kernel"
        out[f"{name}.kind"] = np.array([v.kind for v in some], dtype=str)
        out[name] = np.array([v.k for v in some])
    elif type(first).__name__ in _NESTED:
        kind = type(first).__name__
        _write_fields(name, some, out, columns)
    elif isinstance(first, tuple):
        kind, out[name] = "tuple", np.array(some)
    elif isinstance(first, np.ndarray) or sp.issparse(first):
        kind = "sparse" if sp.issparse(first) else "array"
        arrays = [np.asarray(v.toarray() if sp.issparse(v) else v) for v in some]
        out[f"{name}.shape"] = np.array([a.shape for a in arrays], dtype=np.int64).reshape(len(arrays), -1)
        out[name] = np.concatenate([a.ravel() for a in arrays])
    else:
        kind, out[name] = {bool: "bool", int: "int", float: "float", str: "str"}[_plain(first)], np.array(some)
    columns.append(f"{name} {kind}")


def _plain(value: Any) -> type:
    for kind in (bool, str):
        if isinstance(value, kind):
            return kind
    return int if isinstance(value, (int, np.integer)) else float


def read_graph_arrays(path: str | os.PathLike[str]) -> tuple[Values, list[FactorRecord], dict[str, Any]]:
    """Values, factors and parts of :func:`graph_arrays`."""
    arrays: dict[str, Any] = read_npz(path, fmt=GRAPH_FORMAT)
    try:
        dim = int(arrays["dim"])
        blocks = {w: np.array(arrays[f"values.{w}"], dtype=np.float64) for w in KINDS if f"values.{w}" in arrays}
        for word, rows in blocks.items():
            if rows.ndim != 2 or rows.shape[1] != KINDS[word].size(dim) or not np.all(np.isfinite(rows)):
                raise ValueError(f"values of {word} have shape {rows.shape}")
        values = Values(dim, blocks, arrays["landmark_ids"])
        columns = [c.rsplit(" ", 1) for c in arrays["columns"].tolist()]
        kinds = dict(columns)
        found: dict[int, FactorRecord] = {}
        for batch in factor_kinds():
            name = batch.record.__name__
            if f"{name}.factor_id" in kinds:
                for r in _read_records(batch.record, name, arrays, kinds):
                    found[r.factor_id] = r
        records = [found[i] for i in arrays["order"].tolist()]
        _check_variables(records, values)
        return values, records, {p: arrays[p] for p in PARTS} | {"offset": float(arrays["offset"])}
    except GraphSlamError:
        raise
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise FormatError(f"graph cannot be read ({error})", where=str(path), wanted=GRAPH_FORMAT) from None


def _check_variables(records: Sequence[FactorRecord], values: Values) -> None:
    names = {"x0", *values.layout().names()}
    for r in records:
        missing = [n for n in r.variables() if n not in names]
        if missing:
            raise ValueError(f"{r.label()} is on {missing[0]}, which has no value")


def _read_records(record: type, name: str, arrays: dict[str, Any], kinds: dict[str, str]) -> list[Any]:
    stated = [f.name for f in fields(record) if f.init and f"{name}.{f.name}" in kinds]
    table = [_read(f"{name}.{f}", arrays, kinds) for f in stated]
    lengths = {len(c) for c in table}
    if len(lengths) > 1:
        raise ValueError(f"columns of {name} have lengths {sorted(lengths)}")
    return [record(**dict(zip(stated, row))) for row in zip(*table)]


def _read(name: str, arrays: dict[str, Any], kinds: dict[str, str]) -> list[Any]:
    kind = kinds[name]
    some: list[Any]
    if kind in _NESTED:
        some = _read_records(_NESTED[kind], name, arrays, kinds)
    elif kind == "kernel":
        some = [RobustKernel(k, w) for k, w in zip(arrays[f"{name}.kind"].tolist(), arrays[name].tolist())]
    elif kind in ("array", "sparse"):
        shapes = arrays[f"{name}.shape"]
        size = np.prod(shapes, axis=1).astype(np.int64)
        if size.sum() != len(arrays[name]) or np.any(shapes < 0):
            raise ValueError(f"{name} has {len(arrays[name])} numbers, not {size.sum()}")
        parts = np.split(np.ascontiguousarray(arrays[name]), np.cumsum(size)[:-1])
        some = [p.reshape(s) for p, s in zip(parts, shapes.tolist())]
        if kind == "sparse":
            some = [sp.csr_matrix(p) for p in some]
    elif kind == "tuple":
        some = [tuple(row) for row in arrays[name].tolist()]
    else:
        some = arrays[name].tolist()
    if f"{name}.have" not in arrays:
        return some
    left = iter(some)
    return [next(left) if have else None for have in arrays[f"{name}.have"].tolist()]
