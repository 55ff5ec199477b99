"""The landmark field of Combined SLAM (2012), section 5: a car drives a closed loop through point features.

Controls arrive at 40 Hz with white noise on speed and steering; a forward range-bearing sensor covers 180° and 30 m at
5 Hz. The ground truth is exact: the vehicle moves with the true controls, only its measurements are noisy,
independently per record. Everything is in the frame of the first base pose, so no result needs an alignment.

The paper's parameters (554 features, 126 submaps of about 15 features, 2 km × 2 km, one loop) do not fit into one
world. Worlds ``A`` (two laps, enough features per submap) and ``B`` (one lap as large as the paper's field) reproduce
one half of them each; ``C`` is ``A`` with the sensor of the classic simulator.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from graphslam.core.geometry import Array, rotation2, se2_transform, wrap_angle
from graphslam.core.log import DropCounter, SensorLog, Truth
from graphslam.core.random import SeedTree
from graphslam.core.records import AckermannGeometry, Gps, LandmarkObservations, SteeringControls, Stream
from graphslam.core.trajectory import Trajectory
from graphslam.sim.landmark_config import LandmarkFieldConfig
from graphslam.sim.landmark_layout import landmark_layout
from graphslam.sim.landmark_presets import PRESETS, landmark_field_preset
from graphslam.sim.vehicle import follow_route

__all__ = ["PRESETS", "LandmarkFieldConfig", "landmark_field_preset", "landmark_layout", "simulate_landmark_field"]


@dataclass(slots=True)
class _World:
    """Ground truth and the stamps of the measurements."""

    config: LandmarkFieldConfig
    seeds: SeedTree
    poses: Array
    steering: Array
    landmarks: Array
    drops: DropCounter = field(default_factory=DropCounter)

    def stamps(self, step: np.ndarray) -> Array:
        """Time of control step numbers; one formula for all streams, so equal instants have equal stamps."""
        return np.asarray(step / self.config.control_rate, dtype=np.float64)

    def noise(self, stream: str) -> np.random.Generator:
        return self.seeds.child("noise", stream).generator()


def _measure_controls(world: _World) -> SteeringControls:
    c, rng = world.config, world.noise("controls")
    n = len(world.steering)
    return SteeringControls(
        times=world.stamps(np.arange(n)),
        speed=c.speed_factor * c.speed + c.noise_scale * c.sigma_speed * rng.standard_normal(n),
        steering=world.steering + c.steering_bias + c.noise_scale * c.sigma_steering * rng.standard_normal(n),
        geometry=AckermannGeometry(wheelbase=c.wheelbase, model="front-steer"),
    )


def visible_landmarks(
    c: LandmarkFieldConfig, poses: Array, landmarks: Array
) -> tuple[np.ndarray, np.ndarray, Array, Array]:
    """(scan, landmark, range, bearing) of every feature inside the sensor's sector."""
    if not len(landmarks):
        none = np.zeros(0)
        return none.astype(np.intp), none.astype(np.intp), none, none
    near = cKDTree(poses[:, :2]).sparse_distance_matrix(cKDTree(landmarks), c.max_range, output_type="ndarray")
    i, j = near["i"], near["j"]
    d = np.einsum("ij,ijk->ik", landmarks[j] - poses[i, :2], rotation2(poses[i, 2]))  # Rᵀ (l - p)
    rng_m, bearing = np.hypot(d[:, 0], d[:, 1]), np.arctan2(d[:, 1], d[:, 0])
    # the tree query is exact up to rounding only; the limits are the configuration's
    seen = (rng_m <= c.max_range) & (rng_m >= c.min_range) & (np.abs(bearing) <= c.field_of_view / 2)
    return i[seen], j[seen], rng_m[seen], bearing[seen]


def _measure_landmarks(world: _World) -> LandmarkObservations:
    steps = np.arange(world.config.scan_stride, world.config.steps + 1, world.config.scan_stride)
    return observe_landmarks(
        world.config, world.stamps(steps), world.poses[steps], world.landmarks, world.seeds, drops=world.drops
    )


def observe_landmarks(
    c: LandmarkFieldConfig,
    times: Array,
    poses: Array,
    landmarks: Array,
    seeds: SeedTree,
    *,
    drops: DropCounter,
    hidden: Callable[[Array, npt.NDArray[np.intp]], npt.NDArray[np.bool_]] | None = None,
) -> LandmarkObservations:
    """Range and bearing of point features, with noise, misses and clutter.

    Parameters
    ----------
    times, poses : (n,), (n, 3)
        Stamps of the scans [s] and true poses of the sensor, in the frame of ``landmarks``.
    landmarks : (m, 2)
        Their rows are the identities.
    seeds : SeedTree
        Its branches ``noise/landmarks`` and ``noise/clutter`` are used.
    hidden : callable, optional
        Given the plan position of a sensor ``(q, 2)`` and the row of a landmark ``(q,)``: is the line of sight blocked?
    """
    rng, clutter = (seeds.child("noise", name).generator() for name in ("landmarks", "clutter"))
    scan, ids, ranges, bearings = visible_landmarks(c, poses, landmarks)
    # sorted (the tree query has no defined order), so that random numbers belong to the same features everywhere
    order = np.lexsort((ids, scan))
    if hidden is not None:
        order = order[~hidden(poses[scan[order], :2], ids[order])]
    scan, ids, ranges, bearings = scan[order], ids[order], ranges[order], bearings[order]

    detected = rng.random(len(scan)) < c.detection_probability
    ranges = ranges + c.noise_scale * c.sigma_range * rng.standard_normal(len(scan))
    bearings = bearings + c.noise_scale * c.sigma_bearing * rng.standard_normal(len(scan))
    drops.drop("landmarks", "visible but not detected", int(np.sum(~detected)))
    drops.drop("landmarks", "measured range not positive", int(np.sum(detected & (ranges <= 0))))
    keep = detected & (ranges > 0)

    counts = clutter.poisson(c.clutter_rate, len(times))
    q = int(counts.sum())
    # uniform over the area of the sector: r² is uniform
    clutter_ranges = np.sqrt(clutter.uniform(c.min_range**2, c.max_range**2, q))
    clutter_bearings = clutter.uniform(-c.field_of_view / 2, c.field_of_view / 2, q)

    scan = np.concatenate([scan[keep], np.repeat(np.arange(len(times)), counts)])
    ids = np.concatenate([ids[keep], np.full(q, -1)])
    ranges = np.concatenate([ranges[keep], clutter_ranges])
    bearings = wrap_angle(np.concatenate([bearings[keep], clutter_bearings]))
    order = np.lexsort((bearings, scan))  # right to left, as a sensor sweeps: the order tells nothing of identity
    sigmas = np.tile([c.sigma_range, c.sigma_bearing], (len(scan), 1))
    return LandmarkObservations(
        times=times,
        offsets=np.searchsorted(scan[order], np.arange(len(times) + 1)),
        ranges=ranges[order],
        bearings=bearings[order],
        sigmas=sigmas,
        ids=ids[order].astype(np.int64),
        max_range=c.max_range,
        field_of_view=(-c.field_of_view / 2, c.field_of_view / 2),
    )


def _measure_gps(world: _World) -> Gps:
    c, rng = world.config, world.noise("gps")
    stride = round(c.control_rate / c.gps_rate)
    steps = np.arange(0, c.steps + 1, stride)
    antenna = se2_transform(world.poses[steps], np.broadcast_to(c.gps_lever, (len(steps), 2)))
    fixes = se2_transform(np.asarray(c.gps_frame), antenna)
    return Gps(
        times=world.stamps(steps),
        positions=fixes + c.noise_scale * c.gps_sigma * rng.standard_normal(fixes.shape),
        sigma=np.full(len(steps), c.gps_sigma),
        lever=np.asarray(c.gps_lever),
    )


def simulate_landmark_field(config: LandmarkFieldConfig, seed: int) -> SensorLog:
    """Simulate one run.

    Parameters
    ----------
    seed : int
        Same seed, same bytes. Layout and noise of each stream have their own branches, so enabling GPS or clutter
        changes nothing else; ``config.layout_seed`` keeps the features fixed over runs.

    Returns
    -------
    SensorLog
        Streams ``controls`` (measured, zero-order hold), ``landmarks`` (true ids, -1 for clutter) and, if enabled,
        ``gps``; ground truth at the control rate, one pose more than controls. ``meta`` contains all parameters.
    """
    route, landmarks = landmark_layout(config, seed)
    poses, steering = follow_route(
        route,
        config.steps,
        speed=config.speed,
        dt=1.0 / config.control_rate,
        wheelbase=config.wheelbase,
        max_steering=config.max_steering,
        steering_rate=config.steering_rate,
        look_ahead=config.look_ahead,
    )
    world = _World(config, SeedTree(seed).child("landmark-field"), poses, steering, landmarks)
    streams: dict[str, Stream] = {"controls": _measure_controls(world), "landmarks": _measure_landmarks(world)}
    if config.gps_rate:
        streams["gps"] = _measure_gps(world)
    truth = Truth(
        trajectory=Trajectory(world.stamps(np.arange(len(poses))), poses),
        landmark_ids=np.arange(len(landmarks), dtype=np.int64),
        landmarks=landmarks,
    )
    return SensorLog(
        name="landmark-field",
        streams=streams,
        truth=truth,
        read={name: len(s.times) for name, s in streams.items()},
        dropped=dict(world.drops.counts),
        meta=_meta(config, seed),
    )


def _meta(config: LandmarkFieldConfig, seed: int) -> dict[str, Any]:
    """Parameters of the world as JSON-compatible values."""
    plain = {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(config).items()}
    return {
        "source": "simulation",
        "world": "landmark-field",
        "seed": int(seed),
        "layout_seed": int(seed if config.layout_seed is None else config.layout_seed),
        "frame": "first base",
        "geometry": {"model": "front-steer", "wheelbase": config.wheelbase},
        "noise": {
            "speed": config.sigma_speed,
            "steering": config.sigma_steering,
            "range": config.sigma_range,
            "bearing": config.sigma_bearing,
            "gps": config.gps_sigma if config.gps_rate else None,
            "scale": config.noise_scale,
            "units": "m/s, rad, m, rad, m; standard deviations, independent per record",
        },
        "config": plain,
    }
