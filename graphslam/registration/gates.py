"""The gates of a match between two maps, in one place: front ends and loop closures ask the same questions.

:class:`~graphslam.registration.config.RegistrationGates` are those of a registration by itself. Here are the ones that
need to know more: where the match was expected, and what else was found in the same map. A false match does more harm
than ten right ones do good; so a match that fails any of them is refused, and the words say which and by how much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.poses import group_of
from graphslam.registration.config import RegistrationConfig
from graphslam.registration.register import Registration, failed_gates

VAGUE_POSITION = 0.4
"""A match is refused whose own σ is above this in some direction [m]: nothing holds it there …"""
VAGUE_ANGLE = 0.04
"""… or above this about some axis [rad]."""


class MatchLimits(Protocol):
    """What the gates are set to; see :class:`MatchGates`."""

    @property
    def fitness(self) -> float: ...
    @property
    def fitness_upright(self) -> float: ...
    @property
    def height(self) -> float: ...
    @property
    def shift(self) -> float: ...
    @property
    def margin(self) -> float: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchGates:
    """Gates of a match between two maps, beside those of its registration.

    Parameters
    ----------
    fitness : float
        Least share of the points that the match explains.
    fitness_upright : float
        The same of the points on upright surfaces, where known.
    height : float
        The match is no farther above or below the prediction [m].
    shift : float
        … and horizontally no farther from it than this many σ; infinite where a χ² of the whole pose is asked instead.
    margin : float
        A second mode must be worse by this share of the points.
    mode_distance : float
        … if it is farther off than this [m].
    """

    fitness: float = 0.83
    fitness_upright: float = 0.8
    height: float = 1.6
    shift: float = 2.5
    margin: float = 0.1
    mode_distance: float = 1.5

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            share = f.name in ("fitness", "fitness_upright", "margin")
            if math.isnan(value) or value < 0 or (share and value > 1):
                raise ConfigError(f"gates of a match: {f.name} = {value}; wanted {'0 … 1' if share else '≥ 0'}")


def shift_between(T: ArrayLike, T_prior: ArrayLike) -> float:
    """Horizontal distance between two poses ``(7,)`` or ``(3,)`` [m]."""
    return float(np.hypot(*(np.asarray(T)[:2] - np.asarray(T_prior)[:2])))


def height_between(T: ArrayLike, T_prior: ArrayLike) -> float:
    """Vertical distance between two poses [m]; 0 in two dimensions."""
    a, b = np.asarray(T), np.asarray(T_prior)
    return float(abs(a[2] - b[2])) if len(a) == 7 else 0.0


def tilt_between(T: ArrayLike, T_prior: ArrayLike) -> float:
    """Angle between the verticals of two poses [rad]; 0 in two dimensions.

    Of a match and its prediction, not of a body and a map: a body on a ramp is tilted where the match is right.
    """
    if len(np.asarray(T)) == 3:
        return 0.0
    up = np.array([[0.0, 0.0, 1.0]])
    here, there = (se3.quat_rotate(np.asarray(q)[3:], up)[0] for q in (T, T_prior))
    return math.atan2(float(np.linalg.norm(np.cross(here, there))), float(here @ there))


def failed_match_gates(
    found: Registration,
    T_prior: ArrayLike,
    limits: MatchLimits,
    rules: RegistrationConfig,
    *,
    sigma: float,
    margin: float,
    rise: float = 0.0,
    ask_vague: bool = True,
) -> list[str]:
    """The gates that a match fails, in words; empty for one that is accepted.

    Parameters
    ----------
    T_prior : (7,) or (3,)
        Where it was expected.
    rules : RegistrationConfig
        Whose own gates are asked too; their tilt is that against the prediction.
    sigma : float
        σ of the prediction, horizontally [m].
    margin : float
        See :func:`match_margins`.
    rise : float
        What heights may be off by besides ``limits.height`` [m].
    ask_vague : bool
        Whether the registration's own σ are asked.
    """
    at = found.T_target_source
    g = group_of(at)
    if not found.converged or not np.all(np.isfinite(at)):
        return ["nothing: " + (found.why or "the result is not finite").replace("; ", ", ")]
    tilted = replace(found, tilt=tilt_between(at, T_prior))
    fails = [text] if (text := failed_gates(tilted, rules)) else []
    fitness = found.best_fitness
    if fitness < limits.fitness and not any("fitness" in f for f in fails):
        fails.append(f"fitness {fitness:.3f} < {limits.fitness:g}")
    if found.fitness_upright < limits.fitness_upright and not any("upright" in f for f in fails):  # NaN is not
        fails.append(f"fitness of upright surfaces {found.fitness_upright:.3f} < {limits.fitness_upright:g}")
    if (off := height_between(at, T_prior)) > (height := limits.height + rise):
        fails.append(f"height {off:.2f} m > {height:g}")
    if (moved := shift_between(at, T_prior)) > limits.shift * sigma:
        fails.append(f"shift {moved:.2f} m > {limits.shift:g} σ of {sigma:.2f} m")
    own = np.sqrt(np.diag(found.covariance))
    if ask_vague and (own[g.position].max() > VAGUE_POSITION or np.delete(own, g.position).max() > VAGUE_ANGLE):
        fails.append("vague")
    if margin < limits.margin:
        fails.append(f"margin {margin:.3f} < {limits.margin:g}")
    return fails


def match_margins(found: Sequence[Registration], maps: npt.ArrayLike, apart: float) -> Array:
    """Fitness of each match less that of the best one in the same map ``apart`` [m] or more from it ``(m,)``.

    1 where there is no other. Results that are no results do not compete.

    Parameters
    ----------
    found : sequence of m Registration
    maps : (m,) int
        Which map each was matched to.
    """
    m = len(found)
    out = np.ones(m)
    if m < 2:
        return out
    segment = np.asarray(maps)
    fitness = np.array([r.best_fitness if r.converged else -np.inf for r in found])
    dim = group_of(found[0].T_target_source).dim
    at = np.stack([r.T_target_source[:dim] for r in found])
    rival = (segment[:, None] == segment[None]) & (np.linalg.norm(at[:, None] - at[None], axis=2) >= apart)
    best = np.where(rival, fitness[None], -np.inf).max(axis=1)
    some = np.isfinite(best) & np.isfinite(fitness)
    out[some] = fitness[some] - best[some]
    return out
