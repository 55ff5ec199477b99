"""Plain twin of the detectors of the terrain: what a scan line says, step by step, with lists and dicts."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

Row = tuple[int, int, int, int, int, int]


class PlainLine:
    """One line, its points from the lowest beam up.

    Parameters
    ----------
    points : (m, 3)
        NaN: no return.
    origin : (3,)
    foot : float
    edges, cells : (b,)
    f : Figures
    """

    def __init__(self, points: Any, origin: Any, foot: float, edges: Any, cells: Any, f: Any, nearest: float) -> None:
        self.origin, self.foot, self.edges, self.cells, self.f = origin, foot, list(edges), list(cells), f
        self.nearest = nearest
        self.p, self.s = [], []
        for q in points:
            if not math.isnan(q[0]):
                r = math.hypot(q[0] - origin[0], q[1] - origin[1])
                if r > 0.2:
                    self.p.append(q)
                    self.s.append(r)
        self.z = [self._mean_height(i) for i in range(len(self.p))]
        self.found: dict[tuple[int, int, int, int], int] = {}
        self.repeated: list[tuple[int, int, int, int, int]] = []

    def _mean_height(self, i: int) -> float:
        heights = [self.p[i][2]]
        for order in (range(i - 1, -1, -1), range(i + 1, len(self.p))):
            for j in order:
                if abs(self.s[j] - self.s[i]) > self.f.smooth or abs(self.p[j][2] - heights[0]) > self.f.smooth:
                    break
                heights.append(self.p[j][2])
        return sum(heights) / len(heights)

    def ground(self) -> tuple[list[int], list[tuple[float, float, float, bool]]]:
        """Which points are on the ground; and place, height and slope of the ground before each, and if hidden."""
        f, s, z = self.f, self.s, self.z
        on = [0] * len(s)
        before = []
        place, height, slope, hidden = 0.0, self.foot, 0.0, False
        anchor = (0.0, self.foot)
        first = run = side = 0
        base: tuple[float, float, float] | None = None  # of a climb: place and height before it, and where it ended
        for i in range(len(s)):
            stood = (place, height) if base is None else base[:2]
            before.append((*stood, slope, hidden))
            ahead = s[i] - place
            off = z[i] - (height + slope * ahead)
            led = ahead > -0.05 and (ahead < 2.0 * f.memory or not any(on))
            near = led and abs(off) < f.residual + f.residual_rate * max(ahead, 0.0)
            grown = False
            if near:
                run = 0
            else:
                up = 1 if off > 0 else -1
                step = s[i] - s[i - 1] if i else 0.0
                level = i > 0 and not on[i - 1] and side == up and step > 0 and abs(z[i] - z[i - 1]) < 0.02 + 0.3 * step
                run = run + 1 if level else 1
                side = up
                if off > f.clearance:
                    hidden, run = True, 0
                else:
                    grown = run >= (3 if up > 0 else 6)
            if not near and not grown:
                continue
            if grown:
                first = i - run + 1
                for j in range(first, i):
                    on[j] = 2
                anchor, slope, run = (s[first], z[first]), 0.0, 0
            unseen = not any(on)
            on[i] = 2 if grown else 1
            if near and abs(ahead) < 0.03:
                continue
            if unseen and z[i] - self.foot > f.climb:
                base = (s[i], self.foot, s[i])
            elif base is None:
                within = [j for j in range(i) if on[j] and all(s[i] - s[q] <= f.window for q in range(j, i))]
                points = [(place, height), *((s[j], z[j]) for j in within)]
                at, low = max(points, key=lambda q: z[i] - q[1] - f.slack * (s[i] - q[0]))
                if z[i] - low - f.slack * (s[i] - at) > f.climb:
                    base = (at, low, s[i])
            elif z[i] - base[1] - f.slack * (s[i] - base[0]) <= f.climb or s[i] - base[2] >= f.width:
                base = None
            place, height, hidden = s[i], z[i], False
            while first < i and (not on[first] or s[i] - s[first] >= 0.5):
                if on[first]:
                    anchor = (s[first], z[first])
                first += 1
            if place - anchor[0] >= 0.3:
                slope = (height - anchor[1]) / (place - anchor[0])
                slope = min(max(slope, -f.most_slope), f.most_slope)
        return on, before

    def say(self, channel: int, value: int, x: float, y: float, r: float) -> None:
        """A statement about a place."""
        bands = [b for b, edge in enumerate(self.edges) if r <= edge]
        if not bands or r < self.nearest:
            return
        b = bands[0]
        key = (b, math.floor(x / self.cells[b]), math.floor(y / self.cells[b]), channel)
        if channel < 4:
            self.found[key] = max(value, self.found.get(key, value))
        else:
            self.repeated.append((*key, value))

    def rows(self, line: int) -> list[Row]:
        """All statements, sorted."""
        f, p, s, z = self.f, self.p, self.s, self.z
        on, before = self.ground()
        above: list[float] = []
        for i in range(len(p)):
            near = [(abs(s[j] - s[i]), -j) for j in range(len(p)) if on[j] and abs(s[j] - s[i]) <= f.memory]
            height = z[i] - z[-min(near)[1]] if near else math.nan
            above.append(0.0 if on[i] else height)
        for i in range(len(p)):
            x, y = p[i][0], p[i][1]
            if on[i]:
                self.say(1, 0, x, y, s[i])
                self.say(4, round(1000 * z[i]), x, y, s[i])
                if 0 < i < len(p) - 1 and on[i - 1] and on[i + 1] and s[i + 1] - s[i - 1] < 2 * f.window:
                    share = (s[i] - s[i - 1]) / max(s[i + 1] - s[i - 1], 1e-6)
                    bend = p[i][2] - (1 - share) * p[i - 1][2] - share * p[i + 1][2]
                    self.say(5, round(1000 * abs(bend)), x, y, s[i])
            elif f.clearance < above[i] <= f.above_limit:
                self.say(2 if above[i] <= f.height else 3, 1, x, y, s[i])
            place, height, _, hidden = before[i]
            o = self.origin
            depth = height - f.slack * (s[i] - place) - p[i][2]
            if on[i] != 1 and depth > f.climb and not hidden and o[2] > height > p[i][2]:
                pierced = s[i] * (o[2] - height) / (o[2] - p[i][2])
                level = [
                    s[j] for j in range(i + 1, len(s)) if on[j] and z[j] > height - f.slack * (s[j] - place) - f.climb
                ]
                below = any(pierced + 0.1 < r < s[i] - 0.1 for r in level)
                if pierced < s[i] - 0.1 and pierced - place < f.memory and not below:
                    at = pierced
                    while at <= min(s[i], pierced + f.support_reach):
                        share = at / s[i]
                        where = (o[0] + share * (x - o[0]), o[1] + share * (y - o[1]), at)
                        self.say(1, min(round(100 * depth), 1000), *where)
                        b = next((k for k, edge in enumerate(self.edges[:-1]) if at <= edge), len(self.edges) - 1)
                        at += 0.5 * self.cells[b]
        self._steps(above)
        out = [(line, *key[:3], key[3], value) for key, value in self.found.items()]
        out += [(line, *rest) for rest in self.repeated]
        return sorted(out)

    def _steps(self, above: list[float]) -> None:
        f, s, z = self.f, self.s, self.z
        low = [i for i in range(len(s)) if above[i] <= f.clearance]

        def middle(i: int, j: int) -> tuple[float, float, float]:
            a, b = self.p[i], self.p[j]
            return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (s[i] + s[j])

        for k, i in enumerate(low):
            window = []
            for j in low[k + 1 :]:
                if abs(s[j] - s[i]) > f.window:
                    break
                window.append(j)
            if not window and k + 1 < len(low):
                j = low[k + 1]
                gap = abs(s[j] - s[i])
                if gap < 2.0:
                    self.say(0, max(round(100 * (abs(z[j] - z[i]) - f.slack * gap)), 0), *middle(i, j))
            rises = [abs(z[j] - z[i]) - f.slack * abs(s[j] - s[i]) for j in window]
            if rises:
                end = rises.index(max(rises))
                chain = [i, *window[: end + 1]]
                each = [abs(z[b] - z[a]) - f.slack * abs(s[b] - s[a]) for a, b in itertools.pairwise(chain)]
                best = each.index(max(each))
                self.say(0, max(round(100 * rises[end]), 0), *middle(chain[best], chain[best + 1]))
            own = rises[0] if rises else 0.0
            self.say(0, max(round(100 * own), 0), self.p[i][0], self.p[i][1], s[i])


def plain_rows(lines: Any, edges: Any, cells: Any, figures: Any, nearest: float) -> np.ndarray:
    """Statements of all lines, sorted within each."""
    out: list[Row] = []
    for k in range(len(lines.points)):
        line = PlainLine(lines.points[k], lines.origins[k], float(lines.feet[k]), edges, cells, figures, nearest)
        out += line.rows(k)
    return np.array(out, np.int32).reshape(-1, 6)
