"""Acceptance gates of a match between two maps, used by front ends and loop closures.

:class:`~graphslam.registration.config.RegistrationGates` are the gates of a single registration. The gates here also
use the prediction of the match and competing matches in the same map. A false match does more harm than ten true ones
do good; so a match that fails any gate is rejected, with a message that names the gate and the value.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.config import check_options
from graphslam.core.geometry import Array, ArrayLike
from graphslam.core.poses import group_of
from graphslam.registration.config import RegistrationConfig
from graphslam.registration.register import Registration, failed_gates

VAGUE_POSITION = 0.4
"""A match is rejected if its σ is above this in any direction [m] …"""
VAGUE_ANGLE = 0.04
"""… or above this about some axis [rad]."""


class MatchLimits(Protocol):
    """Values of the gates; see :class:`MatchGates`."""

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
    """Gates of a match between two maps, in addition to those of its registration.

    Parameters
    ----------
    fitness : float
        Least share of explained points.
    fitness_upright : float
        The same for points on upright surfaces, if known.
    height : float
        Largest vertical distance from the prediction [m].
    shift : float
        Largest horizontal distance from the prediction, in σ; infinite if a χ² test of the whole pose is used instead.
    margin : float
        A second mode must have a lower share of explained points by this difference …
    mode_distance : float
        … if its distance is larger than this [m].
    """

    fitness: float = 0.83
    fitness_upright: float = 0.8
    height: float = 1.6
    shift: float = 2.5
    margin: float = 0.1
    mode_distance: float = 1.5

    def __post_init__(self) -> None:
        check_options(self, "gates of a match: ", {"in [0, 1]": "fitness fitness_upright margin", "≥ 0 or inf": "*"})


def shift_between(T: ArrayLike, T_prior: ArrayLike) -> float:
    """Horizontal distance between two poses ``(7,)`` or ``(3,)`` [m]."""
    return float(np.hypot(*(np.asarray(T)[:2] - np.asarray(T_prior)[:2])))


def height_between(T: ArrayLike, T_prior: ArrayLike) -> float:
    """Vertical distance between two poses [m]; 0 in 2-D."""
    a, b = np.asarray(T), np.asarray(T_prior)
    return float(abs(a[2] - b[2])) if len(a) == 7 else 0.0


def tilt_between(T: ArrayLike, T_prior: ArrayLike) -> float:
    """Angle between the z axes of two poses [rad]; 0 in 2-D.

    For a match and its prediction, not for a body and a map: a body on a ramp is correctly tilted.
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
    """Messages of the failed gates of a match; empty if it is accepted.

    Parameters
    ----------
    T_prior : (7,) or (3,)
        Prediction.
    rules : RegistrationConfig
        Its gates are applied, too; their tilt is relative to the prediction.
    sigma : float
        σ of the prediction, horizontally [m].
    margin : float
        See :func:`match_margins`.
    rise : float
        Tolerance of heights in addition to ``limits.height`` [m].
    ask_vague : bool
        Whether the σ of the registration are tested.
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
    if found.fitness_upright < limits.fitness_upright and not any("upright" in f for f in fails):  # NaN passes
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
    """Fitness of each match minus that of the best one in the same map at least ``apart`` [m] away ``(m,)``.

    1 if there is no other. Failed registrations are ignored.

    Parameters
    ----------
    found : sequence of m Registration
    maps : (m,) int
        Map of each match.
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
