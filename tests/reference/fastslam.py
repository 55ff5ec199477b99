"""Slow obvious twin of one FastSLAM step: matrices, dictionaries, brute-force association. One particle."""

from __future__ import annotations

import numpy as np

from graphslam.core.geometry import rotation2, se2_compose, se2_transform, wrap_angle


def measure(pose, sensor, landmark):
    s = se2_compose(pose, sensor)
    d = landmark - s[:2]
    return np.array([np.hypot(*d), wrap_angle(np.arctan2(d[1], d[0]) - s[2])])


def numeric_jacobians(pose, sensor, landmark, h=1e-6):
    """Central differences with respect to the right tangent of the pose (first-order retraction) and the landmark."""
    Hx = np.zeros((2, 3))
    for k in range(3):
        e = h * np.eye(3)[k]
        d = measure(se2_compose(pose, e), sensor, landmark) - measure(se2_compose(pose, -e), sensor, landmark)
        Hx[:, k] = [d[0] / (2 * h), wrap_angle(d[1]) / (2 * h)]
    Hl = np.zeros((2, 2))
    for k in range(2):
        e = h * np.eye(2)[k]
        d = measure(pose, sensor, landmark + e) - measure(pose, sensor, landmark - e)
        Hl[:, k] = [d[0] / (2 * h), wrap_angle(d[1]) / (2 * h)]
    return Hx, Hl


def channels(z):
    """Channels of an observation: range and bearing, or the range alone where the bearing's variance is infinite."""
    return [0] if np.isinf(z[3]) else [0, 1]


def log_density(d2, S):
    """Log of a Gaussian density at Mahalanobis distance² d2."""
    return -0.5 * (d2 + len(S) * np.log(2 * np.pi) + np.log(np.linalg.det(S)))


class SlowParticle:
    """One particle with its features in a dictionary ``slot -> dict``."""

    def __init__(self):
        self.pose = np.zeros(3)
        self.log_weight = 0.0
        self.features = {}
        self.assoc = {}
        self.scan = 0

    def _free_slot(self):
        k = 0
        while k in self.features:
            k += 1
        return k

    def step(self, first_obs, obs, u, Q, normal, sensor, cfg, known=None):
        m, P = se2_compose(self.pose, u), Q.copy()
        rejected = set()
        if cfg["proposal"] == "1.0":
            m, P = se2_compose(m, np.linalg.cholesky(P) @ normal), np.zeros((3, 3))
        match, nearest, polar = self._associate(m, P, obs, sensor, cfg, known)
        for o, z in enumerate(obs):
            ch = channels(z)
            R = np.diag(z[2:])[np.ix_(ch, ch)]
            if o not in match:
                if known is None:
                    self.log_weight += log_density(cfg["gate"][len(ch)], R)
                continue
            f = self.features[match[o]]
            Hx, Hl = (H[ch] for H in numeric_jacobians(m, sensor, f["mean"]))
            S = Hx @ P @ Hx.T + Hl @ f["cov"] @ Hl.T + R
            nu = self._innovation(m, sensor, f, z)
            d2 = nu @ np.linalg.solve(S, nu)
            if known is not None and d2 > cfg["outlier"][len(ch)]:
                self.log_weight += log_density(cfg["outlier"][len(ch)], S)
                del match[o]
                rejected.add(o)
                continue
            self.log_weight += log_density(d2, S)
            if cfg["proposal"] == "2.0":
                K = P @ Hx.T @ np.linalg.inv(S)
                m, P = se2_compose(m, K @ nu), P - K @ S @ K.T
        if cfg["proposal"] == "2.0":
            m = se2_compose(m, np.linalg.cholesky(P) @ normal)
        self.pose = m
        for o, z in enumerate(obs):
            ch = channels(z)
            if o in match:
                f = self.features[match[o]]
                H = numeric_jacobians(m, sensor, f["mean"])[1][ch]
                S = H @ f["cov"] @ H.T + np.diag(z[2:])[np.ix_(ch, ch)]
                K = f["cov"] @ H.T @ np.linalg.inv(S)
                nu = self._innovation(m, sensor, f, z)
                f["mean"], f["cov"] = f["mean"] + K @ nu, f["cov"] - K @ S @ K.T
                f["hits"], f["misses"] = f["hits"] + 1, 0
                self.assoc[first_obs + o] = match[o]
            elif len(ch) == 2 and o not in rejected and (known is not None or nearest[o] > cfg["gate_new"][2]):
                slot = known[o] if known is not None else self._free_slot()
                s = se2_compose(m, sensor)
                mean = se2_transform(s, z[0] * np.array([np.cos(z[1]), np.sin(z[1])]))
                J = rotation2(s[2] + z[1]) @ np.diag([1.0, z[0]])
                self.features[slot] = {
                    "mean": mean,
                    "cov": J @ np.diag(z[2:]) @ J.T,
                    "hits": 1,
                    "misses": 0,
                    "born": self.scan,
                }
                polar[slot] = None
                self.assoc[first_obs + o] = slot
        if known is None:
            self._drop_spurious(first_obs, len(obs), polar, cfg)
        self.scan += 1

    @staticmethod
    def _innovation(m, sensor, f, z):
        nu = z[:2] - measure(m, sensor, f["mean"])
        nu[1] = wrap_angle(nu[1])
        return nu[channels(z)]

    def _associate(self, m, P, obs, sensor, cfg, known):
        polar = {j: measure(m, sensor, f["mean"]) for j, f in self.features.items()}
        nearest = np.full(len(obs), np.inf)
        if known is not None:
            return {o: j for o, j in enumerate(known) if j in self.features}, nearest, polar
        pairs = []
        for o, z in enumerate(obs):
            for j, f in self.features.items():
                ch = channels(z)
                Hx, Hl = (H[ch] for H in numeric_jacobians(m, sensor, f["mean"]))
                S = Hx @ P @ Hx.T + Hl @ f["cov"] @ Hl.T + np.diag(z[2:])[np.ix_(ch, ch)]
                nu = self._innovation(m, sensor, f, z)
                d2 = nu @ np.linalg.solve(S, nu)
                nearest[o] = min(nearest[o], d2)
                if d2 < cfg["gate"][len(ch)]:
                    pairs.append((d2 + np.log(np.linalg.det(S)), o, j))
        match, used = {}, set()
        for _, o, j in sorted(pairs):
            if o not in match and j not in used:
                match[o] = j
                used.add(j)
        return match, nearest, polar

    def _drop_spurious(self, first_obs, n_obs, polar, cfg):
        seen = {self.assoc.get(first_obs + o) for o in range(n_obs)}
        for j, f in list(self.features.items()):
            if f["hits"] >= cfg["confirm"] or f["born"] == self.scan:
                continue
            p = polar[j]
            if p is not None and p[0] < cfg["miss_range"] and cfg["fov"][0] < p[1] < cfg["fov"][1] and j not in seen:
                f["misses"] += 1
            if f["misses"] >= cfg["misses"] or self.scan - f["born"] >= cfg["scans"]:
                del self.features[j]
                self.assoc = {o: s for o, s in self.assoc.items() if s != j}
