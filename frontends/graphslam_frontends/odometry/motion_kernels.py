"""Compiled planar dead reckoning over many control steps: car-like vehicle, speed and yaw rate, recorded odometry."""

from __future__ import annotations

import math

import numpy as np

from graphslam.core.jit import njit

REAR_AXLE, FRONT_STEER = 0, 1


@njit(error_model="numpy")
def steering_increments_kernel(controls, first, model, wheelbase, encoder_offset, noise, increments, covs):
    """Compose the fine steps ``first[k]:first[k + 1]`` into increment k with its covariance.

    controls : (3, s) lengths of fine steps, speed and steering, constant during each.
    noise : (12,) speed, speed fraction, steering, correlated flag, lateral and heading per m, 2 floors; 4 not used.
    increments : (n, 3) out; covs : (n, 3, 3) out, right tangent at the end of the increment.
    """
    dt, speed, steering = controls[0], controls[1], controls[2]
    sv0, sv1, sa, correlated, lateral, heading = noise[0], noise[1], noise[2], noise[3] > 0.5, noise[4], noise[5]
    # Noise n of a steering angle shortens the integrated path: E cos(G + n) = cos(G) exp(-σ²/2), and the same for sin.
    # At 3° that is 1.4 mm per metre, systematic, and after a long loop more than the random part. Corrected here.
    unbias = 1.0 if correlated else math.exp(0.5 * sa * sa)
    P = np.zeros((3, 3))
    S = np.zeros((3, 2))  # sensitivity to errors that stay constant over the increment
    A = np.zeros((3, 3))
    J = np.zeros((3, 2))
    for k in range(len(first) - 1):
        x = y = th = 0.0
        dist = 0.0
        mean_speed = 0.0
        total = 0.0
        P[:] = 0.0
        S[:] = 0.0
        for i in range(first[k], first[k + 1]):
            h, v, a = dt[i], speed[i], steering[i]
            ca, sa_, ta = math.cos(a), math.sin(a), math.tan(a)
            if model == FRONT_STEER:
                ca, sa_ = ca * unbias, sa_ * unbias
                # x' = x + V dt cos(G + φ), φ' = φ + V dt sin(G) / L (simulator of Combined SLAM)
                dx, dy, dth = v * h * ca, v * h * sa_, v * h * sa_ / wheelbase
                jx_v, jy_v, jt_v = h * ca, h * sa_, h * sa_ / wheelbase
                jx_a, jy_a, jt_a = -v * h * sa_, v * h * ca, v * h * ca / wheelbase
            else:
                # speed of the rear-axle centre from that of the encoder wheel: v_c = v / (1 - tan α · H / L)
                g = 1.0 / (1.0 - ta * encoder_offset / wheelbase)
                vc = v * g
                dth = vc * h * ta / wheelbase
                # exact arc; sinc by series where it is straight
                if abs(dth) < 1e-6:
                    dx, dy = vc * h, 0.5 * vc * h * dth
                else:
                    dx, dy = vc * h * math.sin(dth) / dth, vc * h * (1.0 - math.cos(dth)) / dth
                sec2 = 1.0 + ta * ta
                dvc_a = vc * g * sec2 * encoder_offset / wheelbase
                jx_v, jy_v, jt_v = h * g, 0.5 * dth * h * g, h * g * ta / wheelbase
                jt_a = h * (dvc_a * ta + vc * sec2) / wheelbase
                jx_a, jy_a = h * dvc_a, 0.5 * (h * dvc_a * dth + vc * h * jt_a)
            c, s = math.cos(dth), math.sin(dth)
            # adjoint of step⁻¹: propagates right-tangent errors over the step
            ix, iy = -c * dx - s * dy, s * dx - c * dy
            A[0, 0], A[0, 1], A[0, 2] = c, s, iy
            A[1, 0], A[1, 1], A[1, 2] = -s, c, -ix
            A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, 1.0
            # control errors move the end of the step; position part rotated to the end frame
            J[0, 0], J[1, 0], J[2, 0] = c * jx_v + s * jy_v, -s * jx_v + c * jy_v, jt_v
            J[0, 1], J[1, 1], J[2, 1] = c * jx_a + s * jy_a, -s * jx_a + c * jy_a, jt_a
            qv = sv0 * sv0 + (sv1 * v) ** 2
            qa = sa * sa
            P = A @ P @ A.T
            S = A @ S + J
            if not correlated:
                for r in range(3):
                    for q in range(3):
                        P[r, q] += J[r, 0] * qv * J[q, 0] + J[r, 1] * qa * J[q, 1]
            d = math.sqrt(dx * dx + dy * dy)
            dist += d
            mean_speed += abs(v) * h
            total += h
            cx, sx = math.cos(th), math.sin(th)
            x, y, th = x + cx * dx - sx * dy, y + sx * dx + cx * dy, th + dth
        if correlated and total > 0.0:
            v = mean_speed / total
            qv = sv0 * sv0 + (sv1 * v) ** 2
            if mean_speed == 0.0:
                qv = 0.0  # the encoder of a stationary wheel has no error
            for r in range(3):
                for q in range(3):
                    P[r, q] += S[r, 0] * qv * S[q, 0] + S[r, 1] * sa * sa * S[q, 1]
        # side slip and heading drift per metre driven; floors for a stationary vehicle
        P[0, 0] += noise[6] ** 2
        P[1, 1] += noise[6] ** 2 + (lateral * dist) ** 2
        P[2, 2] += noise[7] ** 2 + (heading * dist) ** 2
        increments[k, 0], increments[k, 1] = x, y
        increments[k, 2] = math.pi - (math.pi - th) % (2.0 * math.pi)
        covs[k] = 0.5 * (P + P.T)


@njit(error_model="numpy")
def velocity_increments_kernel(dt, speed, rate, first, noise, increments, covs):
    """Compose the fine steps ``first[k]:first[k + 1]`` of a base that drives arcs into increment k with its covariance.

    dt, speed, rate : (s,) fine steps with constant speed along x and constant yaw rate.
    noise : (12,) as :meth:`graphslam_frontends.odometry.motion.MotionNoise.as_array`.
    increments : (n, 3) out; covs : (n, 3, 3) out, right tangent at the end of the increment.
    """
    sv0, sv1, sw0, sw1, correlated = noise[0], noise[1], noise[8], noise[9], noise[3] > 0.5
    walk_v, walk_w = noise[10] ** 2, noise[11] ** 2
    P = np.zeros((3, 3))
    S = np.zeros((3, 4))  # sensitivity to constant errors: of speed, speed scale, rate, rate scale
    A = np.zeros((3, 3))
    J = np.zeros((3, 4))
    for k in range(len(first) - 1):
        x = y = th = dist = 0.0
        spread = 0.0  # variance of the heading within the increment, from white noise
        P[:] = 0.0
        S[:] = 0.0
        for i in range(first[k], first[k + 1]):
            h, v, w = dt[i], speed[i], rate[i]
            if v == 0.0 and w == 0.0:
                continue  # stationary base
            qv, qw = walk_v / h, walk_w / h  # a walk of variance q · t is a rate of variance q / h over a step of h
            if not correlated:
                qv += sv0 * sv0 + (sv1 * v) ** 2
                qw += sw0 * sw0 + (sw1 * w) ** 2
            d = w * h
            # exact arc: sinc = sin d / d, cosc = (1 - cos d) / d and their derivatives; series where d is small
            if abs(d) < 1e-3:
                sinc, cosc = 1.0 - d * d / 6.0, d * (0.5 - d * d / 24.0)
                dsinc, dcosc = d * (d * d / 30.0 - 1.0 / 3.0), 0.5 - d * d / 8.0
            else:
                sinc, cosc = math.sin(d) / d, 2.0 * math.sin(0.5 * d) ** 2 / d
                dsinc, dcosc = (math.cos(d) - sinc) / d, (math.sin(d) - cosc) / d
            dx, dy = v * h * sinc, v * h * cosc
            c, s = math.cos(d), math.sin(d)
            jvx, jvy = h * sinc, h * cosc
            jwx, jwy = v * h * h * dsinc, v * h * h * dcosc
            # columns: speed, speed scale, rate, rate scale; position part rotated to the end frame
            J[0, 0], J[1, 0], J[2, 0] = c * jvx + s * jvy, -s * jvx + c * jvy, 0.0
            J[0, 2], J[1, 2], J[2, 2] = c * jwx + s * jwy, -s * jwx + c * jwy, h
            for r in range(3):
                J[r, 1], J[r, 3] = J[r, 0] * v, J[r, 2] * w
            ix, iy = -c * dx - s * dy, s * dx - c * dy
            A[0, 0], A[0, 1], A[0, 2] = c, s, iy
            A[1, 0], A[1, 1], A[1, 2] = -s, c, -ix
            A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, 1.0
            P = A @ P @ A.T
            S = A @ S + J
            for r in range(3):
                for q in range(3):
                    P[r, q] += J[r, 0] * qv * J[q, 0] + J[r, 2] * qw * J[q, 2]
            # A heading error n of variance q shortens the integrated path: E cos(θ + n) = cos θ exp(-q/2). Corrected
            # here, so that paths with rate noise are unbiased. The mean variance over a step is that before it plus a
            # third of what the step adds (∫ u² du). Above 0.5 rad² first order does not hold.
            unbias = math.exp(0.5 * min(spread + qw * h * h / 3.0, 0.5))
            dx, dy = dx * unbias, dy * unbias
            spread += qw * h * h
            dist += abs(v) * h
            cx, sx = math.cos(th), math.sin(th)
            x, y, th = x + cx * dx - sx * dy, y + sx * dx + cx * dy, th + d
        if correlated:
            for r in range(3):
                for q in range(3):
                    P[r, q] += (
                        S[r, 0] * sv0 * sv0 * S[q, 0]
                        + S[r, 1] * sv1 * sv1 * S[q, 1]
                        + S[r, 2] * sw0 * sw0 * S[q, 2]
                        + S[r, 3] * sw1 * sw1 * S[q, 3]
                    )
        # side slip and heading drift per metre driven; floors for a stationary vehicle
        P[0, 0] += noise[6] ** 2
        P[1, 1] += noise[6] ** 2 + (noise[4] * dist) ** 2
        P[2, 2] += noise[7] ** 2 + (noise[5] * dist) ** 2
        increments[k, 0], increments[k, 1] = x, y
        increments[k, 2] = math.pi - (math.pi - th) % (2.0 * math.pi)
        covs[k] = 0.5 * (P + P.T)


@njit(error_model="numpy")
def compose_increments_kernel(steps, step_covs, first, increments, covs):
    """Compose independent steps ``first[k]:first[k + 1]``, covariances in the right tangent, into increment k.

    steps : (s, 3); step_covs : (s, 3, 3); increments : (n, 3) out; covs : (n, 3, 3), added to what is there.
    """
    A = np.zeros((3, 3))
    for k in range(len(first) - 1):
        x = y = th = 0.0
        P = np.zeros((3, 3))
        for i in range(first[k], first[k + 1]):
            dx, dy, d = steps[i, 0], steps[i, 1], steps[i, 2]
            c, s = math.cos(d), math.sin(d)
            ix, iy = -c * dx - s * dy, s * dx - c * dy
            A[0, 0], A[0, 1], A[0, 2] = c, s, iy
            A[1, 0], A[1, 1], A[1, 2] = -s, c, -ix
            A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, 1.0
            P = A @ P @ A.T + step_covs[i]
            cx, sx = math.cos(th), math.sin(th)
            x, y, th = x + cx * dx - sx * dy, y + sx * dx + cx * dy, th + d
        increments[k, 0], increments[k, 1] = x, y
        increments[k, 2] = math.pi - (math.pi - th) % (2.0 * math.pi)
        covs[k] += 0.5 * (P + P.T)
