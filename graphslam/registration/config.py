"""Options of a registration and the gates it has to pass."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

from graphslam.core.errors import ConfigError

LEAST_POINTS = 20
"""Source and target of a registration need so many points, and so many pairs must be left."""


def _check(config: Any, *, zero: tuple[str, ...] = ()) -> None:
    for f in fields(config):
        value = getattr(config, f.name)
        if isinstance(value, int | float) and not isinstance(value, bool):
            low = value >= 0 if f.name in zero else value > 0
            if not (low and math.isfinite(value)):
                wanted = "a number ≥ 0" if f.name in zero else "a positive number"
                raise ConfigError(f"registration: {f.name} is {value}; wanted {wanted}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationGates:
    """What a match must have to be accepted. A false one does more harm than ten right ones do good.

    Parameters
    ----------
    fitness : float
        Least share of *all* source points with a neighbour. A source that reaches out of the map fails it.
    fitness_alone : float
        The same where there is no ``fitness_upright`` to go by: in two dimensions, and with hardly any such points.
    fitness_known : float
        Least share of the source points in known space with a neighbour; stands for ``fitness`` where the caller says
        which space is known. Wrong matches pass it far more often: what they do not meet, they leave.
    fitness_upright : float
        Least share of the source points on upright surfaces with a neighbour, in three dimensions; what tells a right
        match from a wrong one best. 0 for frames whose z axis is not up.
    known_share : float
        Least share of the source points that fall into known space, where the caller says which that is.
    degeneracy : float
        Least ratio of the translational eigenvalues; see :mod:`~graphslam.registration.degeneracy`. Three dimensions.
    degeneracy_planar : float
        The same in two dimensions.
    tilt : float
        Greatest angle between the z axes of two frames that should both stand upright [rad]; π for frames that do
        not.
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
        _check(self, zero=tuple(f.name for f in fields(self)))


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationConfig:
    """How a registration is done; see :func:`graphslam.registration.register.register`.

    Parameters
    ----------
    radii : tuple of float
        Greatest distances of a pair, stage by stage [m].
    iterations : int
        At most, a stage.
    near : float
        A source point has a neighbour if one is nearer than this [m].
    max_shift, max_turn : float
        A result farther from its start is refused [m, rad]: it is another place than the one asked about.
    covariance_scale : float
        Of the inverse Hessian with the noise that the pairs show; calibrated in halls, whatever the noise, the bins and
        the number of points (docs/notes/registration.md). Three dimensions.
    floor_sigma, floor_turn : float
        σ added to the covariance, per axis [m, rad]: what is wrong with the map itself. The defaults are for maps whose
        scans are placed to 2 cm and 2 mrad; for 30 m of dead reckoning 5 cm and 5 mrad fit.
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
        _check(self)
        if not self.radii or not all(math.isfinite(r) and r > 0 for r in self.radii):
            raise ConfigError(f"registration: radii are {self.radii}; wanted positive numbers, wide to narrow")
