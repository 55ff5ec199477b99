"""Slow, obvious twins of EKF-SLAM and of its data association: dense matrices, one formula after the other."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.stats import chi2


def wrap(a):
    return (a + np.pi) % (2 * np.pi) - np.pi


def measurement(x, j, sensor):
    """Range and bearing of landmark j, and the Jacobian over the whole state (2, n)."""
    px, py, th = x[:3]
    R = np.array([[np.cos(th), -np.sin(th)], [np.sin(th), np.cos(th)]])
    arm = R @ sensor[:2]
    d = x[3 + 2 * j : 5 + 2 * j] - (np.array([px, py]) + arm)
    r = np.linalg.norm(d)
    z = np.array([r, wrap(np.arctan2(d[1], d[0]) - th - sensor[2])])
    by_d = np.array([[d[0] / r, d[1] / r], [-d[1] / r**2, d[0] / r**2]])
    H = np.zeros((2, len(x)))
    H[:, :2] = -by_d
    H[:, 2] = by_d @ [arm[1], -arm[0]] + [0.0, -1.0]
    H[:, 3 + 2 * j : 5 + 2 * j] = by_d
    return z, H


def innovation(x, pairs, observations, sensor):
    """Stacked innovation, Jacobian and noise of pairs (observation, landmark); ranges alone give one row."""
    nu, H, R = [], [], []
    for o, j in pairs:
        z, rows = measurement(x, j, sensor)
        channels = 1 if np.isinf(observations[o, 3]) else 2
        e = np.array([observations[o, 0] - z[0], wrap(observations[o, 1] - z[1])])
        nu += list(e[:channels])
        H += list(rows[:channels])
        R += list(observations[o, 2 : 2 + channels])
    return np.array(nu), np.array(H).reshape(-1, len(x)), np.diag(R)


def distance2(x, P, pairs, observations, sensor):
    """Joint Mahalanobis distance² of a set of pairs, and its degrees of freedom."""
    nu, H, R = innovation(x, pairs, observations, sensor)
    return float(nu @ np.linalg.solve(H @ P @ H.T + R, nu)), len(nu)


def gate_of(gate, dof):
    return chi2.isf(chi2.sf(gate, 2), dof)


def nearest_neighbour(x, P, observations, sensor, gate):
    """Landmark of each observation: take the pair nearest in shares of its gate, strike out both, go on."""
    L = (len(x) - 3) // 2
    match = np.full(len(observations), -1)
    cost = {}
    for o, j in itertools.product(range(len(observations)), range(L)):
        d2, dof = distance2(x, P, [(o, j)], observations, sensor)
        if d2 <= gate_of(gate, dof):
            cost[o, j] = d2 / gate_of(gate, dof)
    while cost:
        o, j = min(cost, key=cost.get)
        match[o] = j
        cost = {(a, b): c for (a, b), c in cost.items() if a != o and b != j}
    return match


def exhaustive_joint(x, P, observations, sensor, gate):
    """Every hypothesis: most pairings, then least joint distance²; jointly compatible after each observation."""
    L = (len(x) - 3) // 2
    best = (0, np.inf, np.full(len(observations), -1))
    for match in itertools.product(range(-1, L), repeat=len(observations)):
        pairs = [(o, j) for o, j in enumerate(match) if j >= 0]
        if len({j for _, j in pairs}) < len(pairs):
            continue
        if not all(
            distance2(x, P, [p], observations, sensor)[0] <= gate_of(gate, _dof(p, observations)) for p in pairs
        ):
            continue
        d2, compatible = 0.0, True
        for k in range(1, len(pairs) + 1):
            d2, dof = distance2(x, P, pairs[:k], observations, sensor)
            compatible &= d2 <= gate_of(gate, dof)
        if compatible and (len(pairs) > best[0] or (len(pairs) == best[0] and d2 < best[1])):
            best = (len(pairs), d2, np.array(match))
    return best[2], (best[1] if best[0] else 0.0)


def _dof(pair, observations):
    return 1 if np.isinf(observations[pair[0], 3]) else 2


class DenseEkf:
    """The textbook filter: the whole covariance in every step, Joseph's form."""

    def __init__(self, sensor):
        self.sensor = np.asarray(sensor, dtype=float)
        self.x, self.P = np.zeros(3), np.zeros((3, 3))
        self.names = []

    def predict(self, u, Q):
        th = self.x[2]
        R = np.array([[np.cos(th), -np.sin(th)], [np.sin(th), np.cos(th)]])
        d = R @ u[:2]
        F = np.eye(len(self.x))
        F[:2, 2] = [-d[1], d[0]]
        self.x[:2] += d
        self.x[2] = wrap(self.x[2] + u[2])
        G = np.zeros((len(self.x), 3))
        c, s = np.cos(self.x[2]), np.sin(self.x[2])
        G[:3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        self.P = F @ self.P @ F.T + G @ Q @ G.T

    def update(self, pairs, observations):
        if not pairs:
            return
        nu, H, R = innovation(self.x, pairs, observations, self.sensor)
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + R)
        self.x = self.x + K @ nu
        self.x[2] = wrap(self.x[2])
        A = np.eye(len(self.x)) - K @ H
        self.P = A @ self.P @ A.T + K @ R @ K.T

    def add(self, row, name):
        x, y, th = self.x[:3]
        c, s = np.cos(th), np.sin(th)
        arm = np.array([c * self.sensor[0] - s * self.sensor[1], s * self.sensor[0] + c * self.sensor[1]])
        b = th + self.sensor[2] + row[1]
        ray = row[0] * np.array([np.cos(b), np.sin(b)])
        n = len(self.x)
        G = np.zeros((2, n))
        G[:, :2] = np.eye(2)
        G[:, 2] = [-(arm + ray)[1], (arm + ray)[0]]
        Z = np.array([[np.cos(b), -row[0] * np.sin(b)], [np.sin(b), row[0] * np.cos(b)]])
        N = G @ self.P @ G.T + Z @ np.diag(row[2:4]) @ Z.T
        self.P = np.block([[self.P, self.P @ G.T], [G @ self.P, N]])
        self.x = np.concatenate([self.x, [x, y] + arm + ray])
        self.names.append(name)

    def remove(self, name):
        k = self.names.index(name)
        keep = np.delete(np.arange(len(self.x)), [3 + 2 * k, 4 + 2 * k])
        self.x, self.P = self.x[keep], self.P[np.ix_(keep, keep)]
        del self.names[k]

    def known_step(self, u, Q, observations, names):
        self.predict(u, Q)
        old = [(o, self.names.index(n)) for o, n in enumerate(names) if n in self.names]
        fresh = [o for o, n in enumerate(names) if n not in self.names and np.isfinite(observations[o, 3])]
        self.update(old, observations)
        for o in fresh:
            self.add(observations[o], names[o])


class DenseEkfByDistance(DenseEkf):
    """The same filter with nearest neighbour and provisional landmarks, which go if they are not confirmed."""

    def __init__(self, sensor, *, gate, gate_new, confirm_hits, drop_misses, drop_scans, reach, view):
        super().__init__(sensor)
        self.gate, self.gate_new = gate, gate_new
        self.confirm, self.drop_misses, self.drop_scans = confirm_hits, drop_misses, drop_scans
        self.reach, self.view = reach, view
        self.facts = {}  # name -> hits, misses, scan of birth
        self.scan = self.founded = 0
        self.association = []

    def step(self, u, Q, observations):
        self.predict(u, Q)
        predicted = {n: measurement(self.x, j, self.sensor)[0] for j, n in enumerate(self.names)}
        match = nearest_neighbour(self.x, self.P, observations, self.sensor, self.gate)
        fresh = []
        for o, row in enumerate(observations):
            gate = gate_of(self.gate_new, _dof((o, 0), observations))
            d2 = [distance2(self.x, self.P, [(o, j)], observations, self.sensor)[0] for j in range(len(self.names))]
            if match[o] < 0 and np.isfinite(row[3]) and all(d > gate for d in d2):
                fresh.append(o)
        names = [self.names[j] if j >= 0 else None for j in match]
        self.update([(o, j) for o, j in enumerate(match) if j >= 0], observations)
        for o in fresh:
            self.add(observations[o], self.founded)
            self.facts[self.founded] = [0, 0, self.scan]
            names[o] = self.founded
            self.founded += 1
        for n in names:
            if n is not None:
                self.facts[n][0] += 1
                self.facts[n][1] = 0
        self.association += names
        for n, (r, b) in predicted.items():
            hits, _, born = self.facts[n]
            if hits >= self.confirm:
                continue
            if n not in names and r < self.reach and self.view[0] < b < self.view[1]:
                self.facts[n][1] += 1
            if self.facts[n][1] >= self.drop_misses or self.scan - born >= self.drop_scans:
                self.remove(n)
                self.association = [None if a == n else a for a in self.association]
        self.scan += 1
