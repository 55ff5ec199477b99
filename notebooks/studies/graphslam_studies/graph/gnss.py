"""Pseudoranges and the odometer of a car become factors of a graph: start values, clocks, biases of satellites.

The factors themselves are in :mod:`graphslam_studies.graph.pseudorange` and :mod:`graphslam_studies.graph.odometer`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.config import flattened_field
from graphslam.core.errors import ConfigError, DataError, GeometryError
from graphslam.core.geometry import Array
from graphslam.core.gnss import Pseudoranges, TangentPlane
from graphslam.core.poses import SE3
from graphslam.core.records import Odometry
from graphslam.graph.factor_graph_state import FactorGraphState
from graphslam.graph.factors.gps import antenna_terms
from graphslam.graph.noise import NO_KERNEL, RobustKernel, covariance_whiteners
from graphslam.graph.sensors.gps import datum_columns, start_datum
from graphslam_studies.graph.odometer import OdometerPriorRecord, OdometerRecord
from graphslam_studies.graph.pseudorange import ClockRecord, PseudorangeRecord, SatelliteBiasRecord

Index = npt.NDArray[np.int64]
UNKNOWNS = 4
"""Of an epoch by itself: three coordinates and the clock."""
SYSTEM_SIGMA = 10.0
"""σ of what the clock of a system differs from that of GPS [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PseudorangeConfig:
    """How pseudoranges enter the graph.

    Signals that come round a corner or off a wall are longer by tens of metres, and weaker. So σ and the size of a
    satellite's bias may grow as the carrier-to-noise density falls: by ``10^((density_full - C/N0) / density_scale)``.
    """

    sigma_scale: float = 1.0
    """Factor on the stated σ."""
    density_full: float = 45.0
    """Carrier-to-noise density [dBHz] from which on a signal is taken as unobstructed."""
    density_scale: float | None = None
    """Decibels over which σ grows tenfold below that; none: σ does not depend on it."""
    bias_sigma: float | None = None
    """σ of a satellite's bias while its signal is unobstructed [m]; none: there are no biases."""
    bias_time: float = 15.0
    """Time over which a bias stays alike [s]."""
    bias_every: float = 0.0
    """A bias holds for so long before the next one takes over [s]; 0: one for each pseudorange."""
    offset_walk: float = 0.5
    """Walk of the receiver's clock beside its drift [m/√s]."""
    drift_walk: float = 0.05
    """Walk of that drift [m/s/√s]."""
    robust: RobustKernel = flattened_field(NO_KERNEL, robust="kind", robust_width="k")
    """Robust kernel on each pseudorange, and its width in standard deviations."""

    def __post_init__(self) -> None:
        for name in (
            "sigma_scale", "density_full", "density_scale", "bias_sigma", "bias_time", "offset_walk", "drift_walk",
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ConfigError(f"pseudoranges.{name} must be positive, got {value}")
        if not (np.isfinite(self.bias_every) and self.bias_every >= 0):
            raise ConfigError(f"pseudoranges.bias_every must not be negative, got {self.bias_every}")

    def growth(self, density: Array) -> Array:
        """Factor ``(q,)`` on σ and on biases at densities ``(q,)`` [dBHz]."""
        if self.density_scale is None:
            return np.ones_like(density)
        return np.asarray(10.0 ** (np.maximum(self.density_full - density, 0.0) / self.density_scale))


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometerConfig:
    """How wheels and gyro enter the graph."""

    rate_sigma: float = 1e-3
    """σ of the constant bias of the turn rate [rad/s]."""
    scale_sigma: float = 3e-3
    """σ of the scale error of distances."""
    covariance_scale: float = 1.0
    """Factor on the stated covariances."""


def add_odometer(
    graph: FactorGraphState, odometry: Odometry, *, stream: str = "odometry", config: OdometerConfig | None = None
) -> Index:
    """A node at every record of an odometry in space, from node 0 on; bias of the turn rate and scale are solved for.

    Parameters
    ----------
    graph : FactorGraphState
        In space, with the first base alone.
    stream : str
        Its name in the ledger.

    Returns
    -------
    (n,) int64
        Node of every record.
    """
    cfg = config or OdometerConfig()
    if graph.dim != 3 or odometry.increments.shape[1] != 7:
        raise GeometryError("an odometer is of a graph in space", got=odometry.increments.shape, wanted="(n, 7)")
    if graph.structure.count("x") != 1:
        raise DataError("an odometer makes the nodes of an empty graph", got=f"{graph.structure.count('x')} nodes")
    n = len(odometry.times)
    if n < 2:
        raise DataError("an odometer needs two records", where=stream, got=n)
    P = cfg.covariance_scale * odometry.covariances[1:]
    W = covariance_whiteners(P, n - 1, 6, what=f"increment of {stream}")
    entry = graph.next_factor()  # of the ledger alone: the stream stays spent, whichever factor is taken out
    graph.ledger.spend(entry, f"{n - 1} × odometer", [stream], (float(odometry.times[0]), float(odometry.times[-1])))
    poses = [SE3.identity]
    for T in odometry.increments[1:]:
        poses.append(SE3.compose(poses[-1], T))
    graph.structure.append("x", np.array(poses[1:]))
    row = graph.structure.append("odometer", np.zeros(2))
    seconds, twists = np.diff(odometry.times), SE3.log(odometry.increments[1:])
    graph.insert(OdometerPriorRecord(graph.next_factor(), row, (cfg.rate_sigma, cfg.scale_sigma)))
    for k in range(n - 1):
        graph.insert(OdometerRecord(graph.next_factor(), k, k + 1, row, twists[k], float(seconds[k]), W[k]))
    graph.log_event("odometer", stream=stream, nodes=n)
    return np.arange(n)


def add_pseudoranges(
    graph: FactorGraphState,
    ranges: Pseudoranges,
    plane: TangentPlane,
    nodes: npt.ArrayLike,
    *,
    stream: str = "pseudoranges",
    config: PseudorangeConfig | None = None,
) -> list[int]:
    """Give the graph pseudoranges: clocks, biases and the datum come in with them.

    The map stays where it is: its first base is fixed, and the datum says where it lies in the plane.

    Parameters
    ----------
    graph : FactorGraphState
        In space, with nodes that have start values.
    plane : TangentPlane
        East, north and up of the GPS frame.
    nodes : (n,) int
        Node of every epoch; -1: the epoch is left out, and counted.
    stream : str
        Its name in the ledger.

    Returns
    -------
    list of int
        Factor ids, one a pseudorange that was used.
    """
    cfg, at = config or PseudorangeConfig(), np.asarray(nodes, dtype=np.int64)
    if graph.dim != 3:
        raise GeometryError("pseudoranges are of a graph in space", got=f"{graph.dim} dimensions")
    if at.shape != (len(ranges.times),) or np.any(at >= graph.structure.count("x")):
        raise DataError(
            "nodes do not fit the epochs", got=at.shape, wanted=f"({len(ranges.times)},) nodes that are there"
        )
    satellites = plane.satellites(ranges.satellites) if len(ranges.ranges) else np.zeros((0, 3))
    if graph.structure.count("datum") and graph.gps_origin is not None:
        satellites = satellites - graph.gps_origin  # fixes that are there already count from the first of them
    used = np.flatnonzero(at[ranges.epochs] >= 0)
    epochs = np.unique(ranges.epochs[used])
    enough = epochs[np.bincount(ranges.epochs[used], minlength=len(at))[epochs] >= UNKNOWNS]
    if len(enough) < 2:
        raise DataError("too few epochs with four satellites", where=stream, got=len(enough), wanted="two or more")
    growth = cfg.growth(ranges.density)
    sigma = cfg.sigma_scale * ranges.sigmas * growth
    fixes = np.array([_fix(satellites[k], ranges.ranges[k], sigma[k]) for k in _rows_of(ranges, enough)])
    entry = graph.next_factor()  # of the ledger alone, as that of the odometer
    span = float(ranges.times[epochs[0]]), float(ranges.times[epochs[-1]])
    graph.ledger.spend(entry, f"{len(used)} × pseudorange", [stream], span)
    # from here on nothing fails
    arms = np.broadcast_to(ranges.lever, (len(ranges.times), 3))
    if not graph.structure.count("datum"):
        world = SE3.transform(graph.values.poses[at[enough]], arms[enough])
        level = start_datum(world[:, :2], fixes[:, :2], np.full(len(enough), float(np.median(sigma))))
        up = float(np.median(fixes[:, 2] - world[:, 2]))
        graph.values.datum = np.array([*level[:2], up, level[2]])
        graph.gps_origin = np.zeros(3)
        graph.log_event("datum", fixes=len(enough), T_gps_world=graph.values.datum.tolist())
    clocks = _add_clocks(graph, ranges.times[epochs], ranges.times[enough], fixes[:, 3], cfg)
    clock_of = dict(zip(epochs.tolist(), clocks))
    own = _add_biases(graph, ranges, used, growth, cfg)
    systems = _add_systems(graph, ranges.systems[used])
    tilt = graph.structure.count("tilt") > 0
    ids: list[int] = []
    for m, q in enumerate(used.tolist()):
        k = int(ranges.epochs[q])
        fid = graph.next_factor()
        graph.insert(
            PseudorangeRecord(
                fid, int(at[k]), float(ranges.times[k]), arms[k], satellites[q], float(ranges.ranges[q]),
                float(sigma[q]), int(ranges.ids[q]), clock_of[k], own[m], systems.get(int(ranges.systems[q])),
                tilt, cfg.robust,
            )
        )  # fmt: skip
        ids.append(fid)
    left = len(ranges.ranges) - len(used)
    graph.log_event("pseudoranges", stream=stream, factors=len(ids), epochs=len(epochs), dropped=left)
    return ids


def _rows_of(ranges: Pseudoranges, epochs: Index) -> list[slice]:
    return [slice(int(ranges.offsets[k]), int(ranges.offsets[k + 1])) for k in epochs]


def _fix(satellites: Array, distances: Array, sigma: Array) -> Array:
    """East, north, up and clock ``(4,)`` of one epoch, with Cauchy weights from the fourth step on: a start."""
    x = np.zeros(UNKNOWNS)
    for step in range(12):
        d = x[:3] - satellites
        length = np.linalg.norm(d, axis=1)
        r = (length + x[3] - distances) / sigma
        J = np.concatenate([d / length[:, None], np.ones((len(d), 1))], axis=1) / sigma[:, None]
        w = np.ones_like(r) if step < 3 else 1.0 / (1.0 + r**2)
        A = J.T @ (J * w[:, None])
        x = x - np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(UNKNOWNS), J.T @ (w * r))
    return x


def _add_clocks(
    graph: FactorGraphState, times: Array, known: Array, offsets: Array, cfg: PseudorangeConfig
) -> list[int]:
    """Rows of the clocks of all epochs, tied to each other; they start on a robust straight line."""
    drift = float(np.median(np.diff(offsets) / np.diff(known)))
    line = float(np.median(offsets - drift * known)) + drift * times
    first = graph.structure.append("clock", np.column_stack([line, np.full(len(times), drift)]))
    rows = list(range(first, first + len(times)))
    for a, b, dt in zip(rows, rows[1:], np.diff(times).tolist()):
        graph.insert(ClockRecord(graph.next_factor(), a, b, dt, cfg.offset_walk, cfg.drift_walk))
    return rows


def _add_biases(
    graph: FactorGraphState, ranges: Pseudoranges, used: Index, growth: Array, cfg: PseudorangeConfig
) -> list[int | None]:
    """Row of ``satbias`` of every used pseudorange.

    Between two of them a bias forgets with ``bias_time``; what it may change by grows as its signal is obstructed.
    """
    out: list[int | None] = [None] * len(used)
    if cfg.bias_sigma is None:
        return out
    times = ranges.times[ranges.epochs[used]]
    for number in np.unique(ranges.ids[used]).tolist():
        mine = np.flatnonzero(ranges.ids[used] == number)
        before: tuple[int, float, float] | None = None
        starts = [0]
        for k in range(1, len(mine)):
            if times[mine[k]] - times[mine[starts[-1]]] >= max(cfg.bias_every, 1e-9):
                starts.append(k)
        for a, b in zip(starts, [*starts[1:], len(mine)]):
            rows = mine[a:b]
            t, g = float(times[rows].mean()), float(np.exp(np.mean(np.log(growth[used[rows]]))))
            row = graph.structure.append("satbias", np.zeros(1))
            if before is None:
                record = SatelliteBiasRecord(graph.next_factor(), None, row, 0.0, cfg.bias_sigma * g)
            else:
                keep = float(np.exp(-(t - before[1]) / cfg.bias_time))
                size = cfg.bias_sigma * np.sqrt(g * before[2] * (1.0 - keep**2))
                record = SatelliteBiasRecord(graph.next_factor(), before[0], row, keep, float(size))
            graph.insert(record)
            before = row, t, g
            for m in rows.tolist():
                out[m] = row
    return out


def _add_systems(graph: FactorGraphState, systems: Index) -> dict[int, int]:
    """Row of ``satbias`` of every system but the one that is seen most: its time is that of the clock."""
    seen, count = np.unique(systems, return_counts=True)
    rows = {}
    for s in seen.tolist():
        if s == int(seen[np.argmax(count)]):
            continue
        rows[s] = graph.structure.append("satbias", np.zeros(1))
        graph.insert(SatelliteBiasRecord(graph.next_factor(), None, rows[s], 0.0, SYSTEM_SIGMA))
    return rows


def antenna_positions(graph: FactorGraphState, nodes: npt.ArrayLike, arm: Array) -> tuple[Array, Array]:
    """Where an antenna stands in the GPS frame at nodes, and how sure that is.

    Parameters
    ----------
    nodes : (k,) int
    arm : (dim,)
        In the frames of the nodes [m].

    Returns
    -------
    positions : (k, dim)
        Counted from the origin of the GPS frame.
    covariances : (k, dim, dim)
        Of nodes, datum and tilt together.
    """
    values, at = graph.values, np.asarray(nodes, dtype=np.int64)
    if values.datum is None:
        raise DataError("positions in the GPS frame need a datum", wanted="a graph with fixes or pseudoranges")
    y, J = antenna_terms(values.poses[at], values.datum, values.tilt, np.broadcast_to(arm, (len(at), graph.dim)))
    columns = datum_columns(graph, at)
    needed, place = np.unique(columns, return_inverse=True)
    place = place.reshape(columns.shape) - int(needed[0] < 0)
    S = graph.covariance().columns(needed[needed >= 0])
    J = np.where(columns[:, None] < 0, 0.0, J[:, :, : columns.shape[1]])
    return y, np.array([j @ S[np.ix_(p, p)] @ j.T for j, p in zip(J, np.maximum(place, 0))])
