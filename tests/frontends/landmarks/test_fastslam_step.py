"""The compiled FastSLAM step equals its slow obvious twin, with and without known association, 1.0 and 2.0."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from graphslam.core.geometry import se2_compose, wrap_angle
from graphslam_frontends.landmarks.config import GATE_NEW, DelayedInitialisation, RbpfEkfConfig
from graphslam_frontends.landmarks.filter import ParticleSet
from graphslam_frontends.landmarks.measurement_kernels import observe_landmark
from tests.reference.fastslam import SlowParticle, measure, numeric_jacobians

SENSOR = np.array([0.6, -0.3, 0.1])
FOV = (-np.pi / 2, np.pi / 2)


class Recorded:
    """A generator that hands out recorded normals, so the twin can use the same ones."""

    def __init__(self, rng):
        self.rng, self.normals = rng, []

    def standard_normal(self, shape):
        z = self.rng.standard_normal(shape)
        self.normals.append(z)
        return z

    def random(self):
        return self.rng.random()


def world(rng, scans=25, clutter=0.3):
    """A short drive through 12 landmarks with clutter and misses: (u, Q, observations, ids) per scan."""
    landmarks = rng.uniform([-2, -8], [18, 8], (12, 2))
    pose, out = np.zeros(3), []
    Q = np.diag([0.08, 0.04, 0.02]) ** 2
    u = np.array([0.5, 0.01, 0.03])
    for _ in range(scans):
        pose = se2_compose(se2_compose(pose, u), rng.multivariate_normal(np.zeros(3), Q))
        rows, ids = [], []
        for j, l in enumerate(landmarks):
            z = measure(pose, SENSOR, l)
            if z[0] < 10 and FOV[0] < z[1] < FOV[1] and rng.random() < 0.9:
                rows.append([z[0] + 0.1 * rng.standard_normal(), z[1] + 0.02 * rng.standard_normal(), 0.01, 0.0004])
                ids.append(j)
        if rng.random() < clutter:
            rows.append([rng.uniform(1, 10), rng.uniform(*FOV), 0.01, 0.0004])
            ids.append(-1)
        out.append((u, Q, np.array(rows).reshape(-1, 4), np.array(ids, dtype=np.int64)))
    return out


@pytest.mark.parametrize("proposal", ["1.0", "2.0"])
@pytest.mark.parametrize("association", ["likelihood", "known"])
@pytest.mark.parametrize("ranges_only", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_step_equals_slow_twin(proposal, association, ranges_only, seed, monkeypatch):
    rng = np.random.default_rng(seed)
    outlier = 6.0 if ranges_only else 0.0
    # what waits for a landmark is no part of the step
    monkeypatch.setattr("graphslam_frontends.landmarks.filter.DELAYED", DelayedInitialisation(min_ranges=10**6))
    config = RbpfEkfConfig(
        particles=5, proposal=proposal, association=association, ess_fraction=1e-9, outlier_gate=outlier
    )
    recorded = Recorded(rng)
    fast = ParticleSet(config, SENSOR, FOV, 9.0, recorded)
    slow = [SlowParticle() for _ in range(5)]
    margin = np.deg2rad(1.0)
    values = {"gate": config.gate, "gate_new": GATE_NEW, "outlier": outlier or np.inf}
    gates = {name: {2: v, 1: chi2.isf(chi2.sf(v, 2), 1)} for name, v in values.items()}
    cfg = {"proposal": proposal, **gates, "confirm": config.confirm_hits,
               "misses": config.drop_misses, "scans": config.drop_scans, "miss_range": 9.0,
               "fov": (FOV[0] + margin, FOV[1] - margin)}  # fmt: skip
    dropped = matched = rejected = 0
    slots: dict[int, int] = {}
    for u, Q, obs, ids in world(rng):
        if association == "known":
            obs, ids = obs[ids >= 0], ids[ids >= 0]
            known = np.array([slots.setdefault(int(i), len(slots)) for i in ids], dtype=np.int64)
        else:
            known = np.full(len(obs), -1, dtype=np.int64)
        if ranges_only:
            blind = rng.random(len(obs)) < 0.4
            obs[blind, 1], obs[blind, 3] = 0.0, np.inf
        first = fast.observations
        raw = fast.log_weight.copy()
        before = [len(p.features) for p in slow]
        fast.step(u, Q, obs, known)
        for i, p in enumerate(slow):
            p.log_weight = raw[i]
            p.step(first, obs, u, Q, recorded.normals[-1][i], SENSOR, cfg, known if association == "known" else None)
            matched += sum(o >= first for o in p.assoc)
            dropped += len(p.features) < before[i]
            rejected += sum(k in p.features and first + o not in p.assoc for o, k in enumerate(known))
        shift = max(p.log_weight for p in slow)
        for i, p in enumerate(slow):
            np.testing.assert_allclose(fast.pose[i], p.pose, atol=2e-7)
            np.testing.assert_allclose(fast.log_weight[i], p.log_weight - shift, atol=2e-5)
            alive = np.flatnonzero(fast.hits[i] > 0)
            assert list(alive) == sorted(p.features)
            for j in alive:
                f = p.features[j]
                np.testing.assert_allclose(fast.mean[i, j], f["mean"], atol=1e-6)
                np.testing.assert_allclose(fast.cov[i, j], f["cov"][[0, 0, 1], [0, 1, 1]], atol=1e-7)
                assert (fast.hits[i, j], fast.misses[i, j], fast.born[i, j]) == (f["hits"], f["misses"], f["born"])
            a = fast.assoc[i, : fast.observations]
            assert {o: int(s) for o, s in enumerate(a) if s >= 0} == p.assoc
    assert matched > 100  # the comparison had something to compare
    if association == "likelihood":
        assert dropped > 0  # and the spurious-feature logic ran
    elif ranges_only:
        assert rejected > 0  # and the outlier gate


@pytest.mark.parametrize("seed", range(5))
def test_observation_jacobians_equal_finite_differences(seed):
    rng = np.random.default_rng(seed)
    pose, landmark, out = rng.normal(size=3), 5 * rng.normal(size=2) + 3, np.empty(12)
    observe_landmark(*pose, np.asarray(SENSOR), *landmark, out)
    Hx, Hl = numeric_jacobians(pose, SENSOR, landmark)
    z = measure(pose, SENSOR, landmark)
    np.testing.assert_allclose([out[0], wrap_angle(out[1] - z[1])], [z[0], 0], atol=1e-12)
    np.testing.assert_allclose(out[2:8].reshape(2, 3), Hx, atol=1e-8)
    np.testing.assert_allclose(out[8:12].reshape(2, 2), Hl, atol=1e-8)


def test_proposal_matches_the_exact_posterior_with_known_landmarks():
    """With landmarks known almost exactly, the 2.0 proposal is the Kalman posterior of the pose (linear regime)."""
    rng = np.random.default_rng(3)
    n = 20000
    particles = ParticleSet(RbpfEkfConfig(particles=n, association="known", ess_fraction=1e-9), SENSOR, FOV, 9.0, rng)
    landmarks = np.array([[6.0, 2.0], [7.0, -3.0]])
    for j, l in enumerate(landmarks):
        particles.mean[:, j], particles.cov[:, j] = l, [1e-12, 0, 1e-12]
        particles.hits[:, j] = 5
    particles.count[:] = 2
    u, Q = np.array([0.2, 0.0, 0.01]), np.diag([0.02, 0.02, 0.01]) ** 2
    z = np.array([[*measure(u, SENSOR, l), 4e-4, 1e-4] for l in landmarks])
    z[:, :2] += [[0.01, 0.004], [-0.015, 0.002]]
    particles.step(u, Q, z, np.array([0, 1]))
    H = np.vstack([numeric_jacobians(u, SENSOR, l)[0] for l in landmarks])
    R = np.diag(z[:, 2:].ravel())
    nu = np.concatenate([r[:2] - measure(u, SENSOR, l) for r, l in zip(z, landmarks)])
    P = np.linalg.inv(np.linalg.inv(Q) + H.T @ np.linalg.solve(R, H))
    mean = se2_compose(u, P @ H.T @ np.linalg.solve(R, nu))
    sample = particles.pose - mean
    np.testing.assert_allclose(sample.mean(0), 0, atol=4 * np.sqrt(np.diag(P).max() / n) + 2e-5)
    np.testing.assert_allclose(np.cov(sample.T), P, atol=0.04 * np.diag(P).max())
