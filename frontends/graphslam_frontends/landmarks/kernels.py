"""Compiled FastSLAM step (1.0 and 2.0) over all particles of one scan.

Every particle has its own landmarks (2×2 EKFs) and data association (Combined SLAM B1–B4). One call processes one scan
for all particles; all random numbers are in ``normals``, so results do not depend on the order of particles.

Cost per scan is particles × (landmarks + observations × landmarks *near each observation*): predicted bearings are in
buckets, and only the buckets in the gate of an observation are searched.

An observation with an infinite bearing variance is a range only: one channel in innovation, likelihood and gate. It
updates a landmark but cannot initialise one; see :mod:`graphslam_frontends.landmarks.range_only`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from graphslam.core.jit import callee, njit
from graphslam_frontends.landmarks.measurement_kernels import (
    TWO_PI,
    inverse_innovation,
    landmark_block,
    log_2pi_channels,
    observe_landmark,
    pose_block,
    pose_update,
    sample_pose,
    wrap_angle_kernel,
)

# Association result of one observation, as stored in ``assoc`` (slots are ≥ 0)
IGNORED = -1
# known identity, but outside the outlier gate
REJECTED = -2
BUCKETS = 64

# Layout of the ``cfg`` array; gates ending in _1 are for observations of one channel
CFG_PROPOSAL_2, CFG_GATE, CFG_GATE_NEW, CFG_CONFIRM, CFG_MISSES, CFG_SCANS, CFG_MISS_RANGE, CFG_FOV_LO, CFG_FOV_HI = (
    range(9)
)
CFG_GATE_1, CFG_GATE_NEW_1, CFG_OUTLIER, CFG_OUTLIER_1 = range(9, 13)
CFG_LENGTH = 13


@njit(inline="always")
def _of_channels(vb, two, one):
    return one if math.isinf(vb) else two


class ParticleArrays(NamedTuple):
    """Arrays of n particles with up to M landmarks each; hits 0 = free slot."""

    pose: Any
    """(n, 3)"""
    log_weight: Any
    """(n,)"""
    mean: Any
    """(n, M, 2)"""
    cov: Any
    """(n, M, 3): xx xy yy"""
    hits: Any
    """(n, M) int32"""
    misses: Any
    born: Any
    count: Any
    """(n,) int64: slots in use."""
    assoc: Any
    """(n, Q) int32"""


class ScanArrays(NamedTuple):
    """One scan."""

    number: Any
    """Number of the scan in the submap."""
    first: Any
    """Unique index (B4) of its first observation."""
    obs: Any
    """(q, 4): range, bearing, variance of each."""
    known: Any
    """(q,) int64: slot per observation, or -1: association by likelihood."""


class MotionArrays(NamedTuple):
    """The motion before a scan."""

    u: Any
    """(3,): increment."""
    Q: Any
    """(3, 3): its covariance, right tangent."""
    normals: Any
    """(n, 3)"""


class _Landmarks(NamedTuple):
    """Landmarks of one particle."""

    mean: Any
    cov: Any
    hits: Any
    count: Any


class _Pairing(NamedTuple):
    """Results of an association, and work arrays."""

    match: Any
    nearest: Any
    polar: Any
    head: Any
    link: Any
    pair_o: Any
    pair_s: Any
    pair_d: Any
    pair_c: Any


@callee(error_model="numpy")
def _choose(n_pairs, pair_o, pair_s, pair_c, match):
    """Greedy by likelihood, each observation and each landmark at most once; overwrites ``pair_o``."""
    while True:
        best, k = np.inf, -1
        for i in range(n_pairs):
            if pair_o[i] >= 0 and pair_c[i] < best:
                best, k = pair_c[i], i
        if k < 0:
            return
        o, j = pair_o[k], pair_s[k]
        match[o] = j
        for i in range(n_pairs):
            if pair_o[i] == o or pair_s[i] == j:
                pair_o[i] = -1


@callee(error_model="numpy")
def _associate(m, P, landmarks, obs, sensor, cfg, pairing):
    """Maximum-likelihood association of one particle, exclusive (B4, step 2): fills match[o] with a slot or -1.

    nearest[o] is the least Mahalanobis distance² of any landmark to observation o (inf if none is near). polar[j] =
    predicted (range, bearing) of slot j, range < 0 if it is too far away.
    """
    mean, cov, hits, count = landmarks
    match, nearest, polar, head, link, pair_o, pair_s, pair_d, pair_c = pairing
    n_obs = len(obs)
    h = np.empty(12)
    sxy = math.sqrt(max(P[0, 0] + P[1, 1], 0.0))
    sth = math.sqrt(max(P[2, 2], 0.0))
    head[:] = -1
    worst = 0.0
    for j in range(count):
        if hits[j] > 0:
            v = cov[j, 0] + cov[j, 2]
            if v > worst:
                worst = v
    slm = math.sqrt(worst)
    lever = math.sqrt(sensor[0] ** 2 + sensor[1] ** 2)
    # a landmark farther than this (with a margin for rounding) cannot be in a gate, nor missed
    far = cfg[CFG_MISS_RANGE]
    for o in range(n_obs):
        reach = math.sqrt(_of_channels(obs[o, 3], cfg[CFG_GATE_NEW], cfg[CFG_GATE_NEW_1]))
        far = max(far, obs[o, 0] + reach * math.sqrt(obs[o, 2] + (sxy + slm + lever * sth) ** 2))
    far2 = (1.001 * (far + lever)) ** 2
    for j in range(count):
        polar[j, 0] = -1.0
        if hits[j] > 0 and (mean[j, 0] - m[0]) ** 2 + (mean[j, 1] - m[1]) ** 2 <= far2:
            observe_landmark(m[0], m[1], m[2], sensor, mean[j, 0], mean[j, 1], h)
            polar[j, 0], polar[j, 1] = h[0], h[1]
            b = int((h[1] + math.pi) / TWO_PI * BUCKETS) % BUCKETS
            link[j] = head[b]
            head[b] = j
    n_pairs = 0
    for o in range(n_obs):
        match[o] = -1
        nearest[o] = np.inf
        r, be, vr, vb = obs[o, 0], obs[o, 1], obs[o, 2], obs[o, 3]
        gate = _of_channels(vb, cfg[CFG_GATE], cfg[CFG_GATE_1])
        reach = math.sqrt(_of_channels(vb, cfg[CFG_GATE_NEW], cfg[CFG_GATE_NEW_1]))
        # outer bounds of the gate: nothing outside them can have d² below gate_new
        rwin = reach * math.sqrt(vr + (sxy + slm + lever * sth) ** 2)
        near = max(r - rwin, 0.3)
        bwin = reach * math.sqrt(vb + (sth + (sxy + slm + lever * sth) / near) ** 2)
        lo, hi = 0, BUCKETS - 1
        if bwin < math.pi:
            lo = math.floor((be - bwin + math.pi) / TWO_PI * BUCKETS)
            hi = math.floor((be + bwin + math.pi) / TWO_PI * BUCKETS)
            if hi - lo >= BUCKETS:
                lo, hi = 0, BUCKETS - 1
        for b in range(lo, hi + 1):
            j = head[b % BUCKETS]
            while j >= 0:
                if abs(polar[j, 0] - r) <= rwin and abs(wrap_angle_kernel(polar[j, 1] - be)) <= bwin:
                    observe_landmark(m[0], m[1], m[2], sensor, mean[j, 0], mean[j, 1], h)
                    p00, p01, p11 = pose_block(h, P)
                    l00, l01, l11 = landmark_block(h, cov[j, 0], cov[j, 1], cov[j, 2])
                    s00, s01, s11 = p00 + l00 + vr, p01 + l01, p11 + l11 + vb
                    n0, n1 = r - h[0], wrap_angle_kernel(be - h[1])
                    if math.isinf(vb):
                        det = s00
                        d2 = n0 * n0 / s00
                    else:
                        det = s00 * s11 - s01 * s01
                        d2 = (s11 * n0 * n0 - 2.0 * s01 * n0 * n1 + s00 * n1 * n1) / det
                    if d2 < nearest[o]:
                        nearest[o] = d2
                    if d2 < gate and n_pairs < len(pair_o):
                        pair_o[n_pairs], pair_s[n_pairs] = o, j
                        pair_d[n_pairs], pair_c[n_pairs] = d2, d2 + math.log(det)
                        n_pairs += 1
                j = link[j]
    _choose(n_pairs, pair_o, pair_s, pair_c, match)


@njit(error_model="numpy")
def fastslam_step(particles, scan, motion, sensor, cfg):
    """Advance every particle by one scan.

    In known-association mode ``known[o] >= 0`` for all o, and an empty slot is initialised, unless by a range only.

    Parameters
    ----------
    particles : ParticleArrays
        Updated in place.
    scan : ScanArrays
    motion : MotionArrays
    sensor : (3,)
        ``T_base_sensor``.
    cfg : (CFG_LENGTH,)
    """
    pose, log_weight, mean, cov, hits, misses, born, count, assoc = particles
    number, first_obs, obs, known = scan
    u, Q, normals = motion
    n, n_obs, slots = pose.shape[0], obs.shape[0], mean.shape[1]
    h = np.empty(12)
    m = np.empty(3)
    P = np.empty((3, 3))
    L = np.empty((3, 3))
    polar = np.empty((slots, 2))
    head = np.empty(BUCKETS, np.int64)
    link = np.empty(slots, np.int64)
    match = np.empty(n_obs, np.int64)
    nearest = np.empty(n_obs)
    room = max(64, 24 * n_obs)
    pair_o, pair_s = np.empty(room, np.int64), np.empty(room, np.int64)
    pair_d, pair_c = np.empty(room), np.empty(room)
    pairing = _Pairing(match, nearest, polar, head, link, pair_o, pair_s, pair_d, pair_c)
    by_identity = n_obs > 0 and known[0] >= 0
    for i in range(n):
        # motion: x_t = x_{t-1} ∘ u (mean of the prior)
        c, s = math.cos(pose[i, 2]), math.sin(pose[i, 2])
        m[0] = pose[i, 0] + c * u[0] - s * u[1]
        m[1] = pose[i, 1] + s * u[0] + c * u[1]
        m[2] = wrap_angle_kernel(pose[i, 2] + u[2])
        P[:] = Q
        if cfg[CFG_PROPOSAL_2] < 0.5:
            sample_pose(m, P, normals[i], L)  # FastSLAM 1.0: the proposal is the motion prior
            P[:] = 0.0
        if by_identity:
            for o in range(n_obs):
                match[o] = known[o] if hits[i, known[o]] > 0 else -1
                nearest[o] = np.inf
            for j in range(count[i]):
                polar[j, 0] = -1.0
        else:
            _associate(m, P, _Landmarks(mean[i], cov[i], hits[i], count[i]), obs, sensor, cfg, pairing)
        # proposal and weight: sequential over features; the product of the innovation likelihoods is exact for the
        # linearised model
        for o in range(n_obs):
            vr, vb = obs[o, 2], obs[o, 3]
            j = match[o]
            log_2pi = log_2pi_channels(vb)
            if j < 0:
                # a new or ignored observation has the weight of one at the gate
                if not by_identity:
                    gate = _of_channels(vb, cfg[CFG_GATE], cfg[CFG_GATE_1])
                    log_weight[i] -= 0.5 * gate + log_2pi + 0.5 * math.log(_of_channels(vb, vr * vb, vr))
                continue
            observe_landmark(m[0], m[1], m[2], sensor, mean[i, j, 0], mean[i, j, 1], h)
            p00, p01, p11 = pose_block(h, P)
            l00, l01, l11 = landmark_block(h, cov[i, j, 0], cov[i, j, 1], cov[i, j, 2])
            s00, s01, s11 = p00 + l00 + vr, p01 + l01, p11 + l11 + vb
            i00, i01, i11, det = inverse_innovation(s00, s01, s11)
            n0, n1 = obs[o, 0] - h[0], wrap_angle_kernel(obs[o, 1] - h[1])
            d2 = i00 * n0 * n0 + 2.0 * i01 * n0 * n1 + i11 * n1 * n1
            limit = _of_channels(vb, cfg[CFG_OUTLIER], cfg[CFG_OUTLIER_1])
            if by_identity and d2 > limit:  # the likelihood is limited at the gate, so that an outlier has no influence
                match[o] = REJECTED
                log_weight[i] -= 0.5 * limit + log_2pi + 0.5 * math.log(det)
                continue
            log_weight[i] -= 0.5 * d2 + log_2pi + 0.5 * math.log(det)
            if cfg[CFG_PROPOSAL_2] > 0.5:
                pose_update(m, P, h, n0, n1, i00, i01, i11)
        if cfg[CFG_PROPOSAL_2] > 0.5:
            sample_pose(m, P, normals[i], L)
        pose[i] = m
        # map: each feature is an EKF given the sampled path (B1)
        for o in range(n_obs):
            vr, vb = obs[o, 2], obs[o, 3]
            j = match[o]
            if j >= 0:
                observe_landmark(m[0], m[1], m[2], sensor, mean[i, j, 0], mean[i, j, 1], h)
                c0, c1, c2 = cov[i, j, 0], cov[i, j, 1], cov[i, j, 2]
                l00, l01, l11 = landmark_block(h, c0, c1, c2)
                s00, s01, s11 = l00 + vr, l01, l11 + vb
                i00, i01, i11, _ = inverse_innovation(s00, s01, s11)
                g00, g01 = c0 * h[8] + c1 * h[9], c0 * h[10] + c1 * h[11]
                g10, g11 = c1 * h[8] + c2 * h[9], c1 * h[10] + c2 * h[11]
                k00, k01 = g00 * i00 + g01 * i01, g00 * i01 + g01 * i11
                k10, k11 = g10 * i00 + g11 * i01, g10 * i01 + g11 * i11
                n0, n1 = obs[o, 0] - h[0], wrap_angle_kernel(obs[o, 1] - h[1])
                mean[i, j, 0] += k00 * n0 + k01 * n1
                mean[i, j, 1] += k10 * n0 + k11 * n1
                cov[i, j, 0] = c0 - (k00 * g00 + k01 * g01)
                cov[i, j, 1] = c1 - (k00 * g10 + k01 * g11)
                cov[i, j, 2] = c2 - (k10 * g10 + k11 * g11)
                hits[i, j] += 1
                misses[i, j] = 0
                assoc[i, first_obs + o] = j
            elif j == IGNORED and not math.isinf(vb) and (by_identity or nearest[o] > cfg[CFG_GATE_NEW]):
                if by_identity:
                    j = known[o]
                else:
                    j = 0
                    while j < count[i] and hits[i, j] > 0:
                        j += 1
                if j >= count[i]:
                    count[i] = j + 1
                th = m[2] + sensor[2] + obs[o, 1]
                cb, sb = math.cos(m[2]), math.sin(m[2])
                ct, st = math.cos(th), math.sin(th)
                r = obs[o, 0]
                mean[i, j, 0] = m[0] + cb * sensor[0] - sb * sensor[1] + r * ct
                mean[i, j, 1] = m[1] + sb * sensor[0] + cb * sensor[1] + r * st
                # inverse observation model: Σ = J R Jᵀ with J = [[ct, -r st], [st, r ct]]
                q = r * r * vb
                cov[i, j, 0] = ct * ct * vr + st * st * q
                cov[i, j, 1] = ct * st * (vr - q)
                cov[i, j, 2] = st * st * vr + ct * ct * q
                hits[i, j] = 1
                misses[i, j] = 0
                born[i, j] = number
                assoc[i, first_obs + o] = j
                if not by_identity:
                    polar[j, 0] = -1.0
            else:
                assoc[i, first_obs + o] = IGNORED
        if by_identity:
            continue
        # spurious features: provisional ones that were expected but not observed
        for j in range(count[i]):
            if hits[i, j] > 0 and hits[i, j] < cfg[CFG_CONFIRM] and born[i, j] < number:
                in_view = (
                    polar[j, 0] > 0.0
                    and polar[j, 0] < cfg[CFG_MISS_RANGE]
                    and polar[j, 1] > cfg[CFG_FOV_LO]
                    and polar[j, 1] < cfg[CFG_FOV_HI]
                )
                seen = False
                for o in range(n_obs):
                    if assoc[i, first_obs + o] == j:
                        seen = True
                if in_view and not seen:
                    misses[i, j] += 1
                if misses[i, j] >= cfg[CFG_MISSES] or number - born[i, j] >= cfg[CFG_SCANS]:
                    hits[i, j] = 0
                    for k in range(first_obs + n_obs):
                        if assoc[i, k] == j:
                            assoc[i, k] = IGNORED
