"""Options of a registration and the gates it has to pass."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from graphslam.core.config import check_options
from graphslam.core.errors import ConfigError

LEAST_POINTS = 20
"""Least number of points in source and target of a registration, and of pairs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationGates:
    """Acceptance limits of a match. They are strict, because a false match does more harm than ten true ones do good.

    Parameters
    ----------
    fitness : float
        Least share of *all* source points with a neighbour. A source that extends beyond the map fails it.
    fitness_alone : float
        The same without ``fitness_upright``: in 2-D, and with too few such points.
    fitness_known : float
        Least share of the source points in known space with a neighbour; replaces ``fitness`` if the caller gives the
        known space. False matches pass it far more often, because points outside known space are ignored.
    fitness_upright : float
        Least share of the source points on upright surfaces with a neighbour, in 3-D; the best criterion for false
        matches. 0 for frames whose z axis is not up.
    known_share : float
        Least share of the source points in known space, if the caller gives it.
    degeneracy : float
        Least ratio of the translational eigenvalues; see :mod:`~graphslam.registration.degeneracy`. 3-D.
    degeneracy_planar : float
        The same in 2-D.
    tilt : float
        Largest angle between the z axes of two frames that should both be upright [rad]; π for other frames.
    """

    fitness: float = 0.75
    fitness_alone: float = 0.85
    fitness_known: float = 0.85
    fitness_upright: float = 0.75
    known_share: float = 0.5
    degeneracy: float = 0.003
    degeneracy_planar: float = 0.01
    tilt: float = math.radians(4.0)

    def __post_init__(self) -> None:
        check_options(self, "registration: ", {"≥ 0": "*"})


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig:
    """Configuration of a registration; see :func:`graphslam.registration.register.register`.

    Parameters
    ----------
    radii : tuple of float
        Largest distance of a pair, per stage [m].
    iterations : int
        Most iterations per stage.
    near : float
        A source point has a neighbour if one is nearer than this [m].
    max_shift, max_turn : float
        A result farther from its start is rejected [m, rad].
    covariance_scale : float
        Factor on the inverse Hessian with the noise estimated from the pairs; calibrated in simulated halls for any
        noise, bins and number of points (docs/notes/registration.md). 3-D.
    floor_sigma, floor_turn : float
        σ added to the covariance, per axis [m, rad], for errors of the map. The defaults are for maps with scan poses
        accurate to 2 cm and 2 mrad; for 30 m of dead reckoning use 5 cm and 5 mrad.
    """

    radii: tuple[float, ...] = (2.0, 0.5)
    iterations: int = 30
    near: float = 0.25
    max_shift: float = 3.0
    max_turn: float = 0.5
    covariance_scale: float = 3.0
    floor_sigma: float = 0.01
    floor_turn: float = 0.001
    gates: RegistrationGates = field(default_factory=RegistrationGates)

    def __post_init__(self) -> None:
        check_options(self, "registration: ", {"> 0": "*"})
        if not self.radii or not all(math.isfinite(r) and r > 0 for r in self.radii):
            raise ConfigError(f"registration: radii are {self.radii}; wanted positive numbers, wide to narrow")
