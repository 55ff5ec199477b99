"""Rotation-invariant place descriptors from the top view, for place recognition after a large drift.

The surroundings of a place are divided into rings and sectors. Each bin contains the occupied share of a height band
(walls, pillars, cars, not floors or ceilings), and whether the bin is known. Two places are compared at all headings at
once by a masked normalised correlation over the bins known to both (Padfield 2012, "Masked object registration in the
Fourier domain"), the sectors by FFT; the layout is that of Scan Context (Kim and Kim 2018), which uses the largest
height instead; indoors that is the ceiling.

Buildings are repetitive, and so are such descriptors: the most similar place is only a *candidate*, to be tested by
registration, gates and the graph.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from graphslam.core.config import check_options
from graphslam.core.dense import DenseMapView
from graphslam.core.errors import ConfigError, GeometryError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.poses import group_of, remove_roll_pitch

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class DescriptorConfig:
    """Bins of a descriptor, and parameters of the comparison."""

    radius: float = 21.0
    """Radius of the outermost ring [m]."""
    rings: int = 14
    sectors: int = 72
    low: float = -0.4
    """Lower limit of the height band, relative to the place [m] …"""
    high: float = 1.6
    """… and upper limit [m]; not used in 2-D."""
    layer: float = 0.2
    """Height of the layers in the band [m]."""
    blur: float = 0.7
    """Smoothing σ in bins, radially and along the sectors: tolerance for different positions."""
    known: float = 0.6
    """Two places are compared if both know at least this share of the bins that the place with fewer known bins has
    …"""
    least: int = 40
    """… and at least this number."""
    shortlist: int = 200
    """Number of places with the most similar ring keys that are compared."""

    def __post_init__(self) -> None:
        ranges = {"finite": "low high", "≥ 0": "blur", "in (0, 1]": "known", "> 0": "*"}
        check_options(self, "place descriptor: ", ranges)
        if self.high <= self.low:
            raise ConfigError(f"place descriptor: band {self.low} … {self.high}; wanted low < high")


@dataclass(frozen=True, slots=True, eq=False)
class PlaceDescriptors:
    """Descriptors of many places.

    Parameters
    ----------
    values : (n, rings, sectors)
        Occupied share of the band; 0 if unknown.
    known : (n, rings, sectors)
        Whether the bin is known, 0 … 1.
    """

    values: Array
    known: Array
    config: DescriptorConfig

    def __len__(self) -> int:
        return len(self.values)

    def ring_keys(self) -> Array:
        """Rotation-invariant keys: mean of each ring over its known bins, weighted by their share ``(n, rings)``."""
        some = self.known.sum(axis=2)
        return np.asarray(self.values.sum(axis=2) / np.maximum(some, 1e-9) * np.sqrt(some / self.known.shape[2]))


def describe_places(
    view: DenseMapView | None, T_base_place: ArrayLike, config: DescriptorConfig | None = None
) -> PlaceDescriptors:
    """Descriptors of places of one map.

    Parameters
    ----------
    view : DenseMapView or None
        None: a submap without a dense map; all bins are unknown.
    T_base_place : (n, 7) or (n, 3)
        In the frame of the map. Roll and pitch are ignored.
    """
    c = DescriptorConfig() if config is None else config
    T = remove_roll_pitch(np.asarray(T_base_place, dtype=np.float64))
    g = group_of(T)
    if view is None:
        nothing = np.zeros((len(T), c.rings, c.sectors))
        return PlaceDescriptors(nothing, nothing, c)
    if T.ndim != 2 or g.dim != view.dim:
        raise GeometryError("places do not fit the map", got=T.shape, wanted=f"(n, {7 if view.dim == 3 else 3})")
    occupied = view.points()
    tree = cKDTree(occupied[:, :2]) if len(occupied) else None
    shape = (len(T), c.rings, c.sectors)
    layers = max(round((c.high - c.low) / c.layer), 1) if g.dim == 3 else 1
    values, known = np.zeros(shape), np.zeros(shape)
    # a bin is known if its centre is known, at the middle height of the band
    r = (np.arange(c.rings) + 0.5) * c.radius / c.rings
    a = (np.arange(c.sectors) + 0.5) * 2.0 * math.pi / c.sectors - math.pi
    asked = np.zeros((c.rings, c.sectors, g.dim))
    asked[..., 0], asked[..., 1] = r[:, None] * np.cos(a), r[:, None] * np.sin(a)
    if g.dim == 3:
        asked[..., 2] = 0.5 * (c.low + c.high)
    flat = asked.reshape(-1, g.dim)
    for k, pose in enumerate(T):
        inside = view.known_at(g.transform(np.broadcast_to(pose, (len(flat), g.size)), flat))
        known[k] = np.asarray(inside, dtype=np.float64).reshape(shape[1:])
        near = [] if tree is None else tree.query_ball_point(pose[:2], c.radius)
        if len(near):
            p = occupied[near]
            p = g.transform(np.broadcast_to(g.inverse(pose), (len(p), g.size)), p)
            values[k] = _bins(p, c, layers)
    known = np.maximum(known, values > 0)
    if c.blur > 0:
        for axis, mode in ((2, "wrap"), (1, "nearest")):
            values = gaussian_filter1d(values, c.blur, axis=axis, mode=mode)
            known = gaussian_filter1d(known, c.blur, axis=axis, mode=mode)
    known = np.where(known > 0.5, 1.0, 0.0)
    return PlaceDescriptors(values * known, known, c)


def concatenate_descriptors(parts: list[PlaceDescriptors]) -> PlaceDescriptors:
    """Concatenated descriptors of several maps."""
    return PlaceDescriptors(
        np.concatenate([d.values for d in parts]), np.concatenate([d.known for d in parts]), parts[0].config
    )


def descriptor_similarity(
    query: PlaceDescriptors, which: int, others: PlaceDescriptors, rows: Ints
) -> tuple[Array, Array]:
    """Correlation of one place with others at the best heading for each, −1 … 1, and that heading [rad].

    Parameters
    ----------
    which : int
        Row of the query.
    rows : (m,) int
        Rows of ``others``.

    Returns
    -------
    correlation : (m,)
        −1 if too few bins are known to both.
    turn : (m,)
        Heading of the query's frame in that of the other.
    """
    c = query.config
    # sums over rings, at all rotations of the query: Σ_s other[s + t] query[s] = irfft(conj(F_query) F_other)
    a, m_a = others.values[rows], others.known[rows]
    b, m_b = query.values[which], query.known[which]
    F = [np.fft.rfft(x, axis=-1) for x in (a, a * a, m_a)]
    G = [np.conj(np.fft.rfft(x, axis=-1)) for x in (b, b * b, m_b)]

    def over(x: int, y: int) -> Array:
        return np.fft.irfft(np.einsum("mrf,rf->mf", F[x], G[y]), n=c.sectors, axis=-1)

    n = np.maximum(np.round(over(2, 2)), 0.0)
    safe = np.maximum(n, 1.0)
    s_a, s_b = over(0, 2), over(2, 0)
    cross = over(0, 0) - s_a * s_b / safe
    v_a = np.maximum(over(1, 2) - s_a**2 / safe, 0.0)
    v_b = np.maximum(over(2, 1) - s_b**2 / safe, 0.0)
    power = np.sqrt(v_a * v_b)
    fewer = np.minimum(m_a.sum(axis=(1, 2)), m_b.sum())
    enough = (n >= np.maximum(c.known * fewer, c.least)[:, None]) & (power > 1e-9)
    correlation = np.where(enough, cross / np.maximum(power, 1e-9), -1.0)
    best = np.argmax(correlation, axis=1)
    turn = best * 2.0 * math.pi / c.sectors
    turn = np.where(turn > math.pi, turn - 2.0 * math.pi, turn)
    return correlation[np.arange(len(rows)), best], turn


def _bins(points: Array, c: DescriptorConfig, layers: int) -> Array:
    """Occupied share of the layers of the band, by ring and sector."""
    ring = np.floor(np.hypot(points[:, 0], points[:, 1]) * c.rings / c.radius).astype(np.int64)
    sector = np.floor((np.arctan2(points[:, 1], points[:, 0]) + math.pi) * c.sectors / (2.0 * math.pi)).astype(np.int64)
    layer = np.zeros(len(points), np.int64)
    if points.shape[1] == 3:
        layer = np.floor((points[:, 2] - c.low) / c.layer).astype(np.int64)
    use = (ring < c.rings) & (layer >= 0) & (layer < layers)
    cell = (ring[use] * c.sectors + np.clip(sector[use], 0, c.sectors - 1)) * layers + layer[use]
    full = np.zeros(c.rings * c.sectors * layers)
    full[cell] = 1.0
    return np.asarray(full.reshape(c.rings, c.sectors, layers).mean(axis=2))
