"""Dimensions of the garage layouts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from graphslam.core.errors import UnknownNameError
from graphslam.core.geometry import Array
from graphslam.core.random import SeedTree
from graphslam.sim.route import plan_route
from graphslam.sim.world import DRAWN, layout_number

STOREY = 3.2
"""From floor to floor [m]."""
SLAB = 0.3
CORNER_RADIUS = 3.0
RETRACED = 28.0
"""Length of the first part of the route that is driven again at its end [m]."""
ROOM = 1.0
"""Minimum distance from the route to the centre of a pillar in a generated layout [m]."""
_ROAD_RUN = 23.5
"""Plan length of the outdoor ramp [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GarageLayout:
    """A two-level garage, x east and y north of its south-west corner [m].

    Parameters
    ----------
    length, width : float
        Along x and y.
    pitch, first : float
        Positions of pillars and ceiling beams: every ``pitch`` along x, from ``first`` on, the same on both levels.
    rows : tuple of float
        y of the rows of pillars.
    bays : tuple of float
        y of the centres of the rows of parking bays; cars are parked across.
    west, east : float
        x of the cross aisles driven on the lower level; ``west`` is driven on the upper one, too.
    low_aisle : float
        y of the aisle driven on the lower level.
    ramp : (foot, top, y)
        x of its foot and top, y of its centre line; the foot is the eastern end.
    first_aisle, turn, last_aisle : float
        Upper level: y of the first aisle, x where the route turns, y of the last aisle, which leads out to the west.
    road : float
        x of the road outside, which comes down southwards from the upper exit.
    yard : float
        y of the yard south of the building, from where the route enters by the lower entrance.
    cores : tuple of (x0, y0, x1, y1)
        Stairwells, through both levels.
    mirrored, turned : bool
        Mirror y, then turn by 90° to the left; mirroring turns left turns into right ones.
    """

    name: str
    length: float
    width: float
    pitch: float
    first: float
    rows: tuple[float, ...]
    bays: tuple[float, ...]
    west: float
    east: float
    low_aisle: float
    ramp: tuple[float, float, float]
    ramp_width: float
    first_aisle: float
    turn: float
    last_aisle: float
    road: float
    yard: float
    cores: tuple[tuple[float, float, float, float], ...]
    mirrored: bool = False
    turned: bool = False

    @property
    def columns(self) -> Array:
        """x of the pillars of every row [m]."""
        return np.arange(self.first, self.length - 1.0, self.pitch)

    @property
    def road_top(self) -> float:
        """y where the outdoor ramp begins."""
        return self.last_aisle - CORNER_RADIUS - 0.5

    @property
    def road_foot(self) -> float:
        """y where it ends."""
        return self.road_top - _ROAD_RUN

    def waypoints(self) -> list[tuple[float, float, float]]:
        """The route: in from the yard, up the inner ramp, out at the upper exit, down the road, in again."""
        h = STOREY
        foot, top, ramp_y = self.ramp
        outside = [
            (self.road, self.road_foot - 1.5, 0.0),
            (self.road, self.yard, 0.0),
            (self.west, self.yard, 0.0),
        ]
        # two corners save (2 - π/2) r each
        legs = (outside[0][1] - self.yard) + (self.west - self.road)
        end = self.yard + RETRACED + 2 * (2.0 - 1.5707963267948966) * CORNER_RADIUS - legs
        return [
            *outside,
            (self.west, self.low_aisle, 0.0),
            (self.east, self.low_aisle, 0.0),
            (self.east, ramp_y, 0.0),
            (foot, ramp_y, 0.0),
            (top, ramp_y, h),
            (self.west, ramp_y, h),
            (self.west, self.first_aisle, h),
            (self.turn, self.first_aisle, h),
            (self.turn, self.last_aisle, h),
            (self.road, self.last_aisle, h),
            (self.road, self.road_top, h),
            (self.road, self.road_foot, 0.0),
            *outside[1:],
            (self.west, end, 0.0),
        ]


LAYOUTS = {
    "A": GarageLayout(
        name="A", length=60.0, width=36.0, pitch=8.0, first=2.0, rows=(5.0, 11.0, 25.0, 31.0),
        bays=(2.6, 12.9, 23.1, 33.4), west=6.0, east=54.0, low_aisle=8.0, ramp=(42.0, 16.0, 18.0), ramp_width=4.6,
        first_aisle=8.0, turn=46.0, last_aisle=28.0, road=-7.0, yard=-6.5, cores=((54.5, 31.5, 59.7, 35.7),),
    ),
    "B": GarageLayout(
        name="B", length=56.0, width=40.0, pitch=7.0, first=3.2, rows=(4.6, 11.4, 28.6, 35.4),
        bays=(2.4, 13.8, 26.2, 37.6), west=6.7, east=48.7, low_aisle=8.0, ramp=(38.5, 13.5, 20.0), ramp_width=4.6,
        first_aisle=8.0, turn=48.7, last_aisle=32.0, road=-6.5, yard=-3.5, cores=((50.0, 0.3, 55.7, 5.0),),
        mirrored=True,
    ),
    "C": GarageLayout(
        name="C", length=64.0, width=33.0, pitch=7.4, first=2.6, rows=(9.6, 16.2, 20.6, 27.2),
        bays=(6.9, 18.4, 29.8), west=6.3, east=50.7, low_aisle=23.9, ramp=(42.0, 15.5, 4.6), ramp_width=4.4,
        first_aisle=12.9, turn=43.3, last_aisle=23.9, road=-7.4, yard=-7.7,
        cores=((58.0, 28.0, 63.7, 32.7), (52.0, 0.3, 56.0, 4.2)), mirrored=True, turned=True,
    ),
    "D": GarageLayout(
        name="D", length=60.0, width=38.0, pitch=6.6, first=3.0, rows=(5.2, 11.6, 26.4, 32.8),
        bays=(2.6, 13.9, 24.1, 35.4), west=6.3, east=52.5, low_aisle=8.4, ramp=(40.0, 13.0, 19.0), ramp_width=4.6,
        first_aisle=8.4, turn=45.9, last_aisle=29.6, road=-7.2, yard=-5.0, cores=((54.6, 0.3, 59.7, 4.4),),
        turned=True,
    ),
}  # fmt: skip
"""A and B to develop with, C for occasional checks; D is held out: nothing is tuned on it."""


def garage_layout(name: str) -> GarageLayout:
    """The layout of that name, or, for a name such as ``drawn-17``, the one generated from that number."""
    if number := layout_number(name):
        return drawn_layout(number)
    if name not in LAYOUTS:
        raise UnknownNameError("garage layout", name, (*LAYOUTS, f"{DRAWN}N"))
    return LAYOUTS[name]


def drawn_layout(number: int) -> GarageLayout:
    """A garage generated from a number: one of the four plans stretched in both directions, with its pillars, road and
    yard displaced, randomly mirrored and turned."""
    rng = SeedTree(number).child("garage-layout").generator()
    while True:
        g = LAYOUTS[str(rng.choice(list(LAYOUTS)))]
        along, across = rng.uniform(0.95, 1.25), rng.uniform(1.0, 1.2)
        xs = {name: float(along * getattr(g, name)) for name in ("length", "west", "east", "turn")}
        ys = {name: float(across * getattr(g, name)) for name in ("width", "low_aisle", "first_aisle", "last_aisle")}
        found = replace(
            g, name=f"{DRAWN}{number}", **xs, **ys,
            pitch=float(rng.uniform(6.0, 9.0)), first=float(rng.uniform(2.0, 4.0)),
            rows=tuple(float(across * y) for y in g.rows), bays=tuple(float(across * y) for y in g.bays),
            ramp=(float(along * g.ramp[0]), float(along * g.ramp[1]), float(across * g.ramp[2])),
            road=float(g.road - rng.uniform(0.0, 1.5)), yard=float(g.yard - rng.uniform(0.0, 1.5)),
            cores=tuple((along * a, across * b, along * c, across * d) for a, b, c, d in g.cores),
            mirrored=bool(rng.random() < 0.5), turned=bool(rng.random() < 0.5),
        )  # fmt: skip
        end = found.waypoints()[-1][1]
        if not found.yard + CORNER_RADIUS + 1.0 < end < found.low_aisle:
            continue  # the route ends on its first straight
        route = plan_route(np.array(found.waypoints()), CORNER_RADIUS, where=found.name)
        pillars = np.array([(x, y) for x in found.columns for y in found.rows])
        if float(cKDTree(pillars).query(route.positions(route.every(0.1))[:, :2])[0].min()) > ROOM:
            return found
