"""Compiled FastSLAM step (1.0 and 2.0) over all particles of one scan.

Every particle owns its landmarks (2×2 EKFs) and its own data association (Combined SLAM B1–B4). One call handles one
scan for all particles; all randomness comes in as ``normals``, so results do not depend on the order of particles.

Cost per scan is particles × (landmarks + observations × landmarks *near each observation*): predicted bearings are
bucketed, and an observation looks only into the buckets inside its gate.
"""

from __future__ import annotations

import math

import numba
import numpy as np

# Association outcome of one observation, as stored in ``assoc`` (slots are ≥ 0)
IGNORED = -1
BUCKETS = 64
_TWO_PI = 2.0 * math.pi

# Layout of the ``cfg`` array
CFG_PROPOSAL_2, CFG_GATE, CFG_GATE_NEW, CFG_CONFIRM, CFG_MISSES, CFG_SCANS, CFG_MISS_RANGE, CFG_FOV_LO, CFG_FOV_HI = (
    range(9)
)
CFG_LENGTH = 9


@numba.njit(cache=True, inline="always")
def wrap(a):
    """Angle to (-π, π]."""
    return math.pi - (math.pi - a) % _TWO_PI


@numba.njit(cache=True, error_model="numpy")
def observe(x, y, th, ax, ay, ath, lx, ly, out):
    """Range, bearing and their Jacobians for a landmark (lx, ly) seen from pose (x, y, th) with sensor (ax, ay, ath).

    out[0:2] range, bearing; out[2:8] rows of ∂/∂ξ (right tangent of the pose); out[8:12] rows of ∂/∂l.
    """
    c, s = math.cos(th), math.sin(th)
    dx, dy = lx - (x + c * ax - s * ay), ly - (y + s * ax + c * ay)
    r = math.sqrt(dx * dx + dy * dy)
    if r < 1e-6:
        r = 1e-6
    ux, uy = dx / r, dy / r
    ex, ey = c * ux + s * uy, -s * ux + c * uy  # line of sight in the body frame
    out[0] = r
    out[1] = wrap(math.atan2(dy, dx) - th - ath)
    out[2], out[3], out[4] = -ex, -ey, ex * ay - ey * ax
    out[5], out[6], out[7] = ey / r, -ex / r, (-ey * ay - ex * ax) / r - 1.0
    out[8], out[9], out[10], out[11] = ux, uy, -uy / r, ux / r


@numba.njit(cache=True, inline="always")
def _pose_block(h, P):
    """``H_x P H_xᵀ`` (three numbers: 00, 01, 11) for the Jacobian rows h[2:8]."""
    a0 = h[2] * P[0, 0] + h[3] * P[1, 0] + h[4] * P[2, 0]
    a1 = h[2] * P[0, 1] + h[3] * P[1, 1] + h[4] * P[2, 1]
    a2 = h[2] * P[0, 2] + h[3] * P[1, 2] + h[4] * P[2, 2]
    b0 = h[5] * P[0, 0] + h[6] * P[1, 0] + h[7] * P[2, 0]
    b1 = h[5] * P[0, 1] + h[6] * P[1, 1] + h[7] * P[2, 1]
    b2 = h[5] * P[0, 2] + h[6] * P[1, 2] + h[7] * P[2, 2]
    return (
        a0 * h[2] + a1 * h[3] + a2 * h[4],
        a0 * h[5] + a1 * h[6] + a2 * h[7],
        b0 * h[5] + b1 * h[6] + b2 * h[7],
    )


@numba.njit(cache=True, inline="always")
def _landmark_block(h, c0, c1, c2):
    """``H_l Σ H_lᵀ`` (00, 01, 11) for Σ = [[c0, c1], [c1, c2]]."""
    a0, a1 = h[8] * c0 + h[9] * c1, h[8] * c1 + h[9] * c2
    b0, b1 = h[10] * c0 + h[11] * c1, h[10] * c1 + h[11] * c2
    return a0 * h[8] + a1 * h[9], a0 * h[10] + a1 * h[11], b0 * h[10] + b1 * h[11]


@numba.njit(cache=True, error_model="numpy")
def _pose_update(m, P, h, nu0, nu1, i00, i01, i11):
    """EKF update of the proposal Gaussian (mean pose m, right-tangent covariance P) by one observation."""
    G = np.empty((3, 2))
    for r in range(3):
        G[r, 0] = P[r, 0] * h[2] + P[r, 1] * h[3] + P[r, 2] * h[4]
        G[r, 1] = P[r, 0] * h[5] + P[r, 1] * h[6] + P[r, 2] * h[7]
    K = np.empty((3, 2))
    for r in range(3):
        K[r, 0] = G[r, 0] * i00 + G[r, 1] * i01
        K[r, 1] = G[r, 0] * i01 + G[r, 1] * i11
    for r in range(3):
        for q in range(3):
            P[r, q] -= K[r, 0] * G[q, 0] + K[r, 1] * G[q, 1]
    for r in range(3):  # keep it symmetric: rounding must not accumulate over many features
        for q in range(r):
            P[r, q] = P[q, r] = 0.5 * (P[r, q] + P[q, r])
    _retract(m, K[0, 0] * nu0 + K[0, 1] * nu1, K[1, 0] * nu0 + K[1, 1] * nu1, K[2, 0] * nu0 + K[2, 1] * nu1)


@numba.njit(cache=True, inline="always")
def _retract(m, dx, dy, dth):
    """``m ← m ∘ (dx, dy, dθ)``; first-order retraction, equal to Exp to the order of the filter."""
    c, s = math.cos(m[2]), math.sin(m[2])
    m[0] += c * dx - s * dy
    m[1] += s * dx + c * dy
    m[2] = wrap(m[2] + dth)


@numba.njit(cache=True, error_model="numpy")
def _cholesky3(P, L):
    """Lower Cholesky factor of a 3×3 covariance; a direction without variance gets a zero column."""
    L[:] = 0.0
    for i in range(3):
        for j in range(i + 1):
            s = P[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = math.sqrt(s) if s > 0.0 else 0.0
            elif L[j, j] > 0.0:
                L[i, j] = s / L[j, j]


@numba.njit(cache=True, error_model="numpy")
def _sample(m, P, z, L):
    _cholesky3(P, L)
    _retract(m, L[0, 0] * z[0], L[1, 0] * z[0] + L[1, 1] * z[1], L[2, 0] * z[0] + L[2, 1] * z[1] + L[2, 2] * z[2])


@numba.njit(cache=True, error_model="numpy")
def _associate(
    m, P, mean, cov, hits, count, obs, sensor, cfg, match, nearest, polar, head, link, pair_o, pair_s, pair_d, pair_c
):
    """Maximum-likelihood association of one particle, exclusive (B4, step 2): fills match[o] with a slot or -1.

    nearest[o] is the least Mahalanobis distance² of any landmark to observation o (inf if none is near).
    polar[j] = predicted (range, bearing) of slot j, range < 0 where it is out of view.
    """
    n_obs = len(obs)
    h = np.empty(12)
    sxy = math.sqrt(max(P[0, 0] + P[1, 1], 0.0))
    sth = math.sqrt(max(P[2, 2], 0.0))
    head[:] = -1
    worst = 0.0
    for j in range(count):
        polar[j, 0] = -1.0
        if hits[j] > 0:
            observe(m[0], m[1], m[2], sensor[0], sensor[1], sensor[2], mean[j, 0], mean[j, 1], h)
            polar[j, 0], polar[j, 1] = h[0], h[1]
            b = int((h[1] + math.pi) / _TWO_PI * BUCKETS) % BUCKETS
            link[j] = head[b]
            head[b] = j
            v = cov[j, 0] + cov[j, 2]
            if v > worst:
                worst = v
    slm = math.sqrt(worst)
    reach = math.sqrt(cfg[CFG_GATE_NEW])
    n_pairs = 0
    for o in range(n_obs):
        match[o] = -1
        nearest[o] = np.inf
        r, be, vr, vb = obs[o, 0], obs[o, 1], obs[o, 2], obs[o, 3]
        # outer bounds of the gate: nothing outside them can have d² below gate_new
        lever = math.sqrt(sensor[0] ** 2 + sensor[1] ** 2)
        rwin = reach * math.sqrt(vr + (sxy + slm + lever * sth) ** 2)
        near = max(r - rwin, 0.3)
        bwin = reach * math.sqrt(vb + (sth + (sxy + slm + lever * sth) / near) ** 2)
        lo = math.floor((be - bwin + math.pi) / _TWO_PI * BUCKETS)
        hi = math.floor((be + bwin + math.pi) / _TWO_PI * BUCKETS)
        if hi - lo >= BUCKETS:
            lo, hi = 0, BUCKETS - 1
        for b in range(lo, hi + 1):
            j = head[b % BUCKETS]
            while j >= 0:
                if abs(polar[j, 0] - r) <= rwin and abs(wrap(polar[j, 1] - be)) <= bwin:
                    observe(m[0], m[1], m[2], sensor[0], sensor[1], sensor[2], mean[j, 0], mean[j, 1], h)
                    p00, p01, p11 = _pose_block(h, P)
                    l00, l01, l11 = _landmark_block(h, cov[j, 0], cov[j, 1], cov[j, 2])
                    s00, s01, s11 = p00 + l00 + vr, p01 + l01, p11 + l11 + vb
                    det = s00 * s11 - s01 * s01
                    n0, n1 = r - h[0], wrap(be - h[1])
                    d2 = (s11 * n0 * n0 - 2.0 * s01 * n0 * n1 + s00 * n1 * n1) / det
                    if d2 < nearest[o]:
                        nearest[o] = d2
                    if d2 < cfg[CFG_GATE] and n_pairs < len(pair_o):
                        pair_o[n_pairs], pair_s[n_pairs] = o, j
                        pair_d[n_pairs], pair_c[n_pairs] = d2, d2 + math.log(det)
                        n_pairs += 1
                j = link[j]
    # greedy by likelihood, each observation and each landmark at most once
    while True:
        best, k = np.inf, -1
        for i in range(n_pairs):
            if pair_o[i] >= 0 and pair_c[i] < best:
                best, k = pair_c[i], i
        if k < 0:
            break
        o, j = pair_o[k], pair_s[k]
        match[o] = j
        for i in range(n_pairs):
            if pair_o[i] == o or pair_s[i] == j:
                pair_o[i] = -1


@numba.njit(cache=True, error_model="numpy")
def fastslam_step(
    pose,
    log_weight,
    mean,
    cov,
    hits,
    misses,
    born,
    count,
    assoc,
    path,
    scan,
    first_obs,
    obs,
    known,
    u,
    Q,
    normals,
    sensor,
    cfg,
):
    """Advance every particle by one scan.

    pose (n, 3), log_weight (n,), mean (n, M, 2), cov (n, M, 3: xx xy yy), hits/misses/born (n, M) int32 (hits 0 = free
    slot), count (n,) int64 slots in use, assoc (n, Q) int32, path (n, T, 3).
    scan : index of this scan in the submap; first_obs : unique index (B4) of its first observation.
    obs (q, 4) : range, bearing, variance of each. known (q,) int64 : slot per observation, or -1: decide by likelihood;
    in known-association mode ``known[o] >= 0`` for all o and an empty slot is filled.
    u (3,), Q (3, 3) : motion increment and its right-tangent covariance. normals (n, 3). sensor (3,) T_base_sensor.
    """
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
    by_identity = n_obs > 0 and known[0] >= 0
    log_2pi = math.log(_TWO_PI)
    for i in range(n):
        # motion: x_t = x_{t-1} ∘ u (mean of the prior)
        c, s = math.cos(pose[i, 2]), math.sin(pose[i, 2])
        m[0] = pose[i, 0] + c * u[0] - s * u[1]
        m[1] = pose[i, 1] + s * u[0] + c * u[1]
        m[2] = wrap(pose[i, 2] + u[2])
        P[:] = Q
        if cfg[CFG_PROPOSAL_2] < 0.5:
            _sample(m, P, normals[i], L)  # FastSLAM 1.0: the proposal is the motion prior
            P[:] = 0.0
        if by_identity:
            for o in range(n_obs):
                match[o] = known[o] if hits[i, known[o]] > 0 else -1
                nearest[o] = np.inf
            for j in range(count[i]):
                polar[j, 0] = -1.0
        else:
            _associate(
                m,
                P,
                mean[i],
                cov[i],
                hits[i],
                count[i],
                obs,
                sensor,
                cfg,
                match,
                nearest,
                polar,
                head,
                link,
                pair_o,
                pair_s,
                pair_d,
                pair_c,
            )
        # proposal and weight: sequential over features; the product of the innovations' likelihoods is exact
        # for the linearised model
        for o in range(n_obs):
            vr, vb = obs[o, 2], obs[o, 3]
            j = match[o]
            if j < 0:
                # a new or ignored observation weighs as much as one that just fails the gate
                log_weight[i] -= 0.5 * cfg[CFG_GATE] + log_2pi + 0.5 * math.log(vr * vb) if not by_identity else 0.0
                continue
            observe(m[0], m[1], m[2], sensor[0], sensor[1], sensor[2], mean[i, j, 0], mean[i, j, 1], h)
            p00, p01, p11 = _pose_block(h, P)
            l00, l01, l11 = _landmark_block(h, cov[i, j, 0], cov[i, j, 1], cov[i, j, 2])
            s00, s01, s11 = p00 + l00 + vr, p01 + l01, p11 + l11 + vb
            det = s00 * s11 - s01 * s01
            n0, n1 = obs[o, 0] - h[0], wrap(obs[o, 1] - h[1])
            i00, i01, i11 = s11 / det, -s01 / det, s00 / det
            log_weight[i] -= 0.5 * (i00 * n0 * n0 + 2.0 * i01 * n0 * n1 + i11 * n1 * n1) + log_2pi + 0.5 * math.log(det)
            if cfg[CFG_PROPOSAL_2] > 0.5:
                _pose_update(m, P, h, n0, n1, i00, i01, i11)
        if cfg[CFG_PROPOSAL_2] > 0.5:
            _sample(m, P, normals[i], L)
        pose[i] = m
        path[i, scan] = m
        # map: each feature an EKF given the sampled path (B1)
        for o in range(n_obs):
            vr, vb = obs[o, 2], obs[o, 3]
            j = match[o]
            if j >= 0:
                observe(m[0], m[1], m[2], sensor[0], sensor[1], sensor[2], mean[i, j, 0], mean[i, j, 1], h)
                c0, c1, c2 = cov[i, j, 0], cov[i, j, 1], cov[i, j, 2]
                l00, l01, l11 = _landmark_block(h, c0, c1, c2)
                s00, s01, s11 = l00 + vr, l01, l11 + vb
                det = s00 * s11 - s01 * s01
                i00, i01, i11 = s11 / det, -s01 / det, s00 / det
                g00, g01 = c0 * h[8] + c1 * h[9], c0 * h[10] + c1 * h[11]
                g10, g11 = c1 * h[8] + c2 * h[9], c1 * h[10] + c2 * h[11]
                k00, k01 = g00 * i00 + g01 * i01, g00 * i01 + g01 * i11
                k10, k11 = g10 * i00 + g11 * i01, g10 * i01 + g11 * i11
                n0, n1 = obs[o, 0] - h[0], wrap(obs[o, 1] - h[1])
                mean[i, j, 0] += k00 * n0 + k01 * n1
                mean[i, j, 1] += k10 * n0 + k11 * n1
                cov[i, j, 0] = c0 - (k00 * g00 + k01 * g01)
                cov[i, j, 1] = c1 - (k00 * g10 + k01 * g11)
                cov[i, j, 2] = c2 - (k10 * g10 + k11 * g11)
                hits[i, j] += 1
                misses[i, j] = 0
                assoc[i, first_obs + o] = j
            elif by_identity or nearest[o] > cfg[CFG_GATE_NEW]:
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
                born[i, j] = scan
                assoc[i, first_obs + o] = j
                if not by_identity:
                    polar[j, 0] = -1.0
            else:
                assoc[i, first_obs + o] = IGNORED
        if by_identity:
            continue
        # spurious features: provisional ones that should have been seen again and were not
        for j in range(count[i]):
            if hits[i, j] > 0 and hits[i, j] < cfg[CFG_CONFIRM] and born[i, j] < scan:
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
                if misses[i, j] >= cfg[CFG_MISSES] or scan - born[i, j] >= cfg[CFG_SCANS]:
                    hits[i, j] = 0
                    for k in range(first_obs + n_obs):
                        if assoc[i, k] == j:
                            assoc[i, k] = IGNORED
