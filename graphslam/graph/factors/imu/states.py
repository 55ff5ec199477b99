"""Velocity and bias rows of each node, taken from the factors of an IMU."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from graphslam.core.geometry import Array
from graphslam.core.imu import ImuNoise
from graphslam.graph.factors.imu.preintegration import bias_sigma, walk_sigma
from graphslam.graph.factors.imu.records import ForceRecord, ImuBiasRecord, ImuRecord


@dataclass(frozen=True, slots=True)
class ImuStates:
    """States of one IMU.

    Parameters
    ----------
    order : tuple of int
        Nodes in order of time.
    time : dict of int to float
    velocity, bias : dict of int to int
        Node → row of :attr:`~graphslam.graph.variables.Values.velocities` and of ``imu_biases``.
    """

    order: tuple[int, ...]
    time: dict[int, float]
    velocity: dict[int, int]
    bias: dict[int, int]

    @classmethod
    def of(cls, records: Iterable[Any], stream: str) -> ImuStates:
        """From the factors of a stream."""
        time: dict[int, float] = {}
        velocity: dict[int, int] = {}
        bias: dict[int, int] = {}
        for r in records:
            if isinstance(r, ImuRecord) and r.stream == stream:
                for n, t, v, b in zip((r.i, r.j), r.interval, r.velocities, r.biases):
                    time[n], bias[n] = float(t), b
                    if v >= 0:
                        velocity[n] = v
            elif isinstance(r, ForceRecord) and r.stream == stream:
                time[r.node], bias[r.node] = r.time, r.bias
        return cls(tuple(sorted(time, key=time.__getitem__)), time, velocity, bias)


def required_bias_links(
    states: ImuStates, records: Iterable[Any], stream: str, noise: ImuNoise
) -> dict[tuple[int | None, int], Array]:
    """(previous bias or None, bias) → σ ``(6,)``: prior of the first, and walks without a preintegrated measurement."""
    linked = {r.biases[1] for r in records if isinstance(r, ImuRecord) and r.stream == stream}
    out: dict[tuple[int | None, int], Array] = {}
    for before, node in zip((None, *states.order), states.order):
        b = states.bias[node]
        if before is None:
            out[None, b] = bias_sigma(noise)
        elif b not in linked:
            out[states.bias[before], b] = walk_sigma(noise, states.time[node] - states.time[before])
    return out


def renumber_states(records: Mapping[int, Any]) -> tuple[dict[int, Any], list[int], list[int]]:
    """Changed records after renumbering the used rows of velocities and biases, and the old rows that are kept."""
    v = sorted({k for r in records.values() if isinstance(r, ImuRecord) for k in r.velocities if k >= 0})
    b = sorted(
        {k for r in records.values() if isinstance(r, ImuRecord) for k in r.biases}
        | {r.bias for r in records.values() if isinstance(r, (ForceRecord, ImuBiasRecord))}
    )
    new_v, new_b = {-1: -1} | {k: n for n, k in enumerate(v)}, {k: n for n, k in enumerate(b)}
    out: dict[int, Any] = {}
    for fid, r in records.items():
        if isinstance(r, ImuRecord):
            (va, vb), (ba, bb) = r.velocities, r.biases
            vs, bs = (new_v[va], new_v[vb]), (new_b[ba], new_b[bb])
            if (vs, bs) != (r.velocities, r.biases):
                out[fid] = replace(r, velocities=vs, biases=bs)
        elif isinstance(r, ForceRecord) and new_b[r.bias] != r.bias:
            out[fid] = replace(r, bias=new_b[r.bias])
        elif isinstance(r, ImuBiasRecord):
            before = None if r.before is None else new_b[r.before]
            if (before, new_b[r.bias]) != (r.before, r.bias):
                out[fid] = replace(r, before=before, bias=new_b[r.bias])
    return out, v, b
