"""Bags of ROS 1 and ROS 2 and MCAP files, read by the package ``rosbags``, without ROS.

It reads ``LaserScan``, ``PointCloud2``, Livox ``CustomMsg``, ``Imu``, ``Odometry``, ``NavSatFix``, and the transforms
of ``tf_static`` and ``tf``. If several topics have the same kind, raw data are preferred, then the topic with most
messages; options select another one. The notes of the log list the choice. Other messages are counted by type.

* Stamps are those of the headers, or receive times of the bag if the headers have none.
* Odometry is from ``Odometry``, or else from the transform of an ``odom`` frame to the robot; with a planar laser it is
  planar. Its covariance grows with distance and rotation (options); covariances of the messages are not used.
* The base is the child frame of odometry, or else a usual base frame, or that of the scanner. A scanner without a known
  mounting is assumed at the base, with a note; an IMU without one is not used.
* GPS messages without a fix or with impossible positions are dropped and counted; positions are ENU at the first fix.
"""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from graphslam.core import se3
from graphslam.core.errors import ConfigError, DataError
from graphslam.core.geodesy import geodetic_to_ecef
from graphslam.core.geometry import Array
from graphslam.core.gnss import TangentPlane
from graphslam.core.imu import GRAVITY, Imu
from graphslam.core.log import FAR_FIX, DropCounter, SensorLog
from graphslam.core.point_clouds import PointClouds
from graphslam.core.reading import finite_mask
from graphslam.core.records import Gps, LaserScans, Odometry, Stream
from graphslam.io.bag_files import BagFiles
from graphslam.io.bag_messages import (
    WANTED,
    CloudSpool,
    SpooledClouds,
    choose_topics,
    collect_messages,
)
from graphslam.io.clock import usable_records
from graphslam.io.cloud_logs import CUT_SCAN, IMU_NOISE, cut_scans
from graphslam.io.frame_tree import BASE_FRAMES, FrameTree, TopicRows, leaf
from graphslam.io.odometry_noise import DEFAULT_NOISE, OdometryNoise
from graphslam.io.planar_scans import unify_layout
from graphslam.io.point_times import PointTimes, choose_point_times

FIX_SIGMA = 5.0
"""σ of a fix without a usable covariance [m]."""
FAR = 1000.0
"""A fix closer than this to the median of all is never dropped as too far away [m]."""
FEWEST_FIXES = 5
"""With fewer fixes, none is dropped as too far away."""
_MOST_FAR = 3600.0  # [s] a larger difference between stamps of headers and of the bag is noted


@dataclass(frozen=True, slots=True)
class BagTopics:
    """Topics of a bag by kind; ``none``: do not read this kind; None: prefer raw data, then most messages.

    Odometry may also be ``tf:FRAME``: the moving transform with this parent frame.
    """

    clouds: str | None = None
    laser: str | None = None
    odometry: str | None = None
    imu: str | None = None
    gps: str | None = None


ALL_TOPICS = BagTopics()


def read_bag(
    path: str | os.PathLike[str],
    *,
    topics: BagTopics = ALL_TOPICS,
    base_frame: str | None = None,
    mount: tuple[float, float, float, float, float, float] | None = None,
    point_times: bool = True,
    max_range: float | None = None,
    accelerometer_unit: Literal["m/s2", "g"] = "m/s2",
    noise: OdometryNoise = DEFAULT_NOISE,
) -> SensorLog:
    """Read a bag.

    Parameters
    ----------
    path : path
        A ``.bag``, ``.db3`` or ``.mcap`` file, or a folder with one bag.
    topics : BagTopics
        Topics to read.
    base_frame : str, optional
        Frame of the robot.
    mount : (6,), optional
        Pose of the scanner in the base, replaces the transforms: x, y, z [m], roll, pitch, yaw [rad].
    point_times : bool
        Use the times of points, if clouds have them.
    max_range : float, optional
        Maximal range of a planar laser [m], replaces that of its messages.
    accelerometer_unit : {"m/s2", "g"}
    noise : OdometryNoise
        Noise of the odometry.
    """
    if max_range is not None and not (np.isfinite(max_range) and max_range > 0):
        raise ConfigError(f"bag: max_range is {max_range}; wanted a positive number")
    p, counter, notes = Path(path), DropCounter(), list[str]()
    asked: dict[str, str | None] = asdict(topics)
    frame_asked = (topics.odometry or "").partition("tf:")[2] or None
    if frame_asked is not None:
        asked["odometry"] = "none"
    with ExitStack() as stack:
        bag = BagFiles(p, stack)
        chosen = choose_topics(bag, asked, notes, counter)
        frames, rows, spool = collect_messages(bag, chosen, counter)
    frames.fix_constant()
    made, streams = _BagLog(str(p), rows, frames, counter, notes), dict[str, Stream]()
    if "odometry" not in rows and topics.odometry != "none" and (moving := made.moving(frame_asked)) is not None:
        rows["odometry"] = moving
    planar = "laser" in chosen and "clouds" not in chosen
    base = made.base = base_frame or made.frame_of_base()
    if spool is not None:
        streams["clouds"] = made.clouds(spool, mount, point_times)
    if "laser" in rows and "clouds" not in streams:
        streams["laser"] = made.laser(made.place("laser", mount), max_range)
    if "odometry" in rows:
        streams["odometry"] = made.odometry(planar, noise)
    if "imu" in rows and (unit := made.imu(accelerometer_unit)) is not None:
        streams["imu"] = unit
    if "gps" in rows and (fixes := made.gps(planar)) is not None:
        streams["gps"] = fixes
    if not streams:
        raise DataError("the bag has no usable messages", where=str(p), got=dict(counter.counts), wanted=WANTED)
    read = {k: len(rows[k].stamps) for k in streams}
    scanners = [k for k in ("clouds", "laser") if k in streams and k not in made.moved]
    lost = [] if mount else [k for k in scanners if not frames.know(base, rows[k].frame)]
    names = {k: t.name for k, t in chosen.items()}
    meta: dict[str, Any] = {"source": p.name, "notes": notes, "base_frame": base, "topics": names, "unplaced": lost}
    if made.point_times is not None:
        meta |= {"point_times": made.point_times.state, "assumed": made.point_times.assumed()}
    return SensorLog(name=p.stem, streams=streams, read=read, dropped=dict(counter.counts), meta=meta)


class _BagLog:
    """Streams of a log from the messages of a bag.

    Parameters
    ----------
    where : str
        Path of the bag, for error messages.
    rows : dict of str to TopicRows
        Message values by kind.
    counter, notes
        Dropped records and notes so far; both are extended.
    """

    def __init__(
        self, where: str, rows: dict[str, TopicRows], frames: FrameTree, counter: DropCounter, notes: list[str]
    ) -> None:
        self.where, self.rows, self.frames, self.counter, self.notes = where, rows, frames, counter, notes
        self.base = ""
        self.point_times: PointTimes | None = None
        self.moved: list[str] = []
        self._times: dict[str, Array] = {}

    def _stamps(self, kind: str) -> Array:
        """Stamps of the headers [s], or receive times of the bag if the headers have none."""
        if kind not in self._times:
            self._times[kind] = self._choose_stamps(kind)
        return self._times[kind]

    def _choose_stamps(self, kind: str) -> Array:
        r = self.rows[kind]
        t, b = np.array(r.stamps), np.array(r.bag_stamps)
        if np.mean(t <= 0.0) > 0.5 or (len(t) > 2 and np.ptp(t) == 0.0):
            self.notes.append(f"{kind} has no stamps in its headers: times of the bag are used")
            return b
        if np.abs(np.median(t - b)) > _MOST_FAR:
            self.notes.append(f"headers of {kind} are {np.median(t - b):.0f} s from the bag's clock")
        return t

    def moving(self, parent: str | None) -> TopicRows | None:
        """Odometry from the moving transforms, or None."""
        key = self.frames.odometry({self.rows[k].frame for k in ("clouds", "laser") if k in self.rows}, parent)
        if key is None:
            if parent is not None:
                known = ", ".join(f"{a} → {b}" for a, b in self.frames.moving) or "none"
                raise ConfigError(f"bag: no frame moves in {parent!r} (option odometry); moving transforms: {known}")
            return None
        rows = self.frames.moving[key]
        rows.frame, rows.child = key
        self.notes.append(f"odometry from the transform {key[0]} → {key[1]}")
        return rows

    def frame_of_base(self) -> str:
        if "odometry" in self.rows and self.rows["odometry"].child:
            return self.rows["odometry"].child
        known = sorted({f for key in self.frames.fixed for f in key}, key=len)
        for name in BASE_FRAMES:
            if found := [f for f in known if leaf(f) == name]:
                return found[0]
        return next((self.rows[k].frame for k in ("clouds", "laser", "imu") if k in self.rows), "base_link")

    def place(self, kind: str, mount: tuple[float, ...] | None) -> Array:
        """``T_base_sensor`` ``(7,)`` of a scanner."""
        if mount is not None:
            if not np.all(finite_mask(mount)):
                raise ConfigError(f"bag: mount is {mount}; wanted 6 finite numbers")
            q = np.array([0.0, 0, 0, 1.0])
            for axis, angle in ((2, mount[5]), (1, mount[4]), (0, mount[3])):
                turn = np.zeros(4)
                turn[axis], turn[3] = np.sin(angle / 2), np.cos(angle / 2)
                q = se3.quat_multiply(q, turn)
            return np.concatenate([mount[:3], q])
        frame = self.rows[kind].frame
        found = self.frames.between(self.base, frame)
        if found is None:
            self.notes.append(
                f"no transform from {self.base!r} to {frame!r}: {kind} taken as at the base, looking ahead"
                " (option mount=)"
            )
            return np.array([0.0, 0, 0, 0, 0, 0, 1])
        return found

    def _kept(self, kind: str, bad: dict[str, Any]) -> tuple[Array, Any]:
        """Stamps of the kept records, and their mask. Half may be dropped: ROS repeats and delays some messages.

        Several sensors, or layers of one, may share a topic: the records of one frame are kept.
        """
        times, r = self._stamps(kind), self.rows[kind]
        others = np.array([bool(f) and f != r.frame for f in r.frames] or [False] * len(times))
        bad = {f"of another frame than {r.frame!r}": others, **bad}
        limit = 0.5 + 0.5 * float(others.mean())
        keep = usable_records(times, bad, stream=kind, where=f"{self.where}, {kind}", drops=self.counter, limit=limit)
        return times[keep], keep

    def clouds(self, spool: CloudSpool, mount: tuple[float, ...] | None, timed: bool) -> PointClouds:
        counts = np.array(self.rows["clouds"].values, dtype=np.int64)
        if not counts.any():
            raise DataError("all clouds are empty", where=self.where, got=dict(self.counter.counts), wanted="points")
        stamps, frame = self._stamps("clouds"), self.rows["clouds"].frame
        fixed = mount is not None or self.frames.know(self.base, frame)
        T = None if fixed else self.frames.moving_place(self.base, frame, stamps)
        if T is not None:  # the driver has already transformed all points to that frame
            self.moved.append("clouds")
            self.notes.append(f"clouds in {frame!r}, which moves: brought to {self.base!r} by the transforms")
        self.point_times = choose_point_times(spool.spans if timed and T is None else (), stamps)
        times, keep = self._kept("clouds", {"no point in it": counts == 0, CUT_SCAN: cut_scans(counts)})
        self.notes.append(self.point_times.note)
        source = SpooledClouds(spool, counts, stamps, self.point_times.clock, T)
        place = self.place("clouds", mount) if T is None else np.array([0.0, 0, 0, 0, 0, 0, 1])
        return PointClouds(times=times, source=source, index=np.flatnonzero(keep), T_base_sensor=place)

    def laser(self, place: Array, max_range: float | None) -> LaserScans:
        up = float(se3.quat_rotate(place[3:], np.array([0.0, 0, 1]))[2])
        if abs(up) < 0.9:
            self.notes.append("the laser does not scan level: its tilt is left out")
        known: dict[tuple[float, float, int], Array] = {}
        values = self.rows["laser"].values
        lasts = float(np.median([v[5] for v in values]))
        if np.isfinite(lasts) and lasts > 0.0:
            self.notes.append(
                f"not used: time_increment of the laser (a scan lasts {lasts:.3g} s), because all beams of a planar"
                " scan count as of its stamp"
            )
        scans, odd, reach = [], np.zeros(len(values), np.bool_), []
        for k, (ranges, start, step, low, high, _) in enumerate(values):
            n = len(ranges)
            if n < 2 or not np.all(finite_mask([start, step])) or not 0 < abs(step) * (n - 1) <= 2.2 * np.pi:
                odd[k] = True
                scans.append((np.zeros(2, np.float32), np.array([0.0, 1.0])))
                continue
            if up < 0:  # upside-down mounting reverses the sense of rotation
                start, step = -start, -step
            beams = known.setdefault((start, step, n), np.sort(start + step * np.arange(n)))
            seen = np.where(np.isfinite(ranges) & (ranges >= max(low, 0.0)) & (ranges > 0), ranges, np.nan)
            seen[np.isposinf(ranges)] = np.inf
            scans.append((seen[::-1] if step < 0 else seen, beams))
            reach.append(high)
        times, keep = self._kept("laser", {"angles are impossible, or fewer than 2 beams": odd})
        rows, beams, moved = unify_layout([s for s, good in zip(scans, keep) if good])
        self.counter.drop("laser", f"scan of other beams mapped to the usual {len(beams)} (kept)", moved)
        stated = [v for v in reach if np.isfinite(v) and v > 0]
        far = max_range or (float(np.median(stated)) if stated else 80.0)
        yaw = 2.0 * np.arctan2(place[5], place[6])
        if up < 0:
            ahead = se3.quat_rotate(place[3:], np.array([1.0, 0, 0]))
            yaw = np.arctan2(ahead[1], ahead[0])
        mounting = np.array([place[0], place[1], np.arctan2(np.sin(yaw), np.cos(yaw))])
        return LaserScans(times=times, ranges=rows, bearings=beams, max_range=far, T_base_sensor=mounting)

    def odometry(self, planar: bool, noise: OdometryNoise) -> Odometry:
        a = np.array(self.rows["odometry"].values)
        norm = np.linalg.norm(np.where(finite_mask(a[:, 3:]), a[:, 3:], 0.0), axis=1)
        bad = {
            "pose is not finite": np.asarray(~finite_mask(a).all(axis=1)),
            "rotation is no unit quaternion": np.abs(norm - 1.0) > 0.05,
        }
        times, keep = self._kept("odometry", bad)
        a = a[keep]
        poses = np.column_stack([a[:, :3], se3.quat_normalize(a[:, 3:])])
        if planar:
            R = se3.quat_to_matrix(poses[:, 3:])
            poses = np.column_stack([poses[:, :2], np.arctan2(R[:, 1, 0], R[:, 0, 0])])
        return noise.odometry(times, poses)

    def imu(self, unit: str) -> Imu | None:
        frame = self.rows["imu"].frame
        place = self.frames.between(self.base, frame) if frame else None
        if place is None and frame != self.base:
            self.notes.append(f"imu left out: no transform from {self.base!r} to {frame!r}")
            self.counter.drop("imu", "unknown mounting", len(self.rows["imu"].values))
            return None
        a = np.array(self.rows["imu"].values)
        times, keep = self._kept("imu", {"reading is not finite": np.asarray(~finite_mask(a).all(axis=1))})
        force = a[keep, 3:] * (GRAVITY if unit == "g" else 1.0)
        T = np.array([0.0, 0, 0, 0, 0, 0, 1]) if place is None else place
        return Imu(times=times, angular_rate=a[keep, :3], specific_force=force, noise=IMU_NOISE, T_base_imu=T)

    def gps(self, planar: bool) -> Gps | None:
        values = self.rows["gps"].values
        g, status = np.array([v[0] for v in values]), np.array([v[2] for v in values])
        place_ok = finite_mask(g[:, :2]).all(axis=1) & (np.abs(g[:, 0]) <= 90) & (np.abs(g[:, 1]) <= 360)
        bad = {
            "no fix (status)": status < 0,
            "no place on Earth": ~np.asarray(place_ok),
            "latitude and longitude are 0": (g[:, :2] == 0.0).all(axis=1),
        }
        no_height = np.asarray(~finite_mask(g[:, 2]))
        unknown = int(no_height[place_ok].sum())
        flat = planar or 2 * unknown > int(place_ok.sum())
        if not flat:
            bad["altitude is not finite"] = no_height
        elif not planar:
            self.notes.append(f"heights of gps are not used: {unknown} of {int(place_ok.sum())} are not finite")
        llh = np.where(finite_mask(g), g, 0.0)
        bad[FAR_FIX] = far_fixes(llh, ~np.logical_or.reduce(list(bad.values())))
        wrong = np.logical_or.reduce(list(bad.values()))
        if wrong.all():
            for reason, mask in bad.items():
                self.counter.drop("gps", reason, int(mask.sum()))
            self.notes.append(f"gps left out: none of {len(g)} messages is a fix")
            return None
        times = self._stamps("gps")
        good = np.flatnonzero(~wrong)
        for reason, mask in bad.items():
            self.counter.drop("gps", reason, int(mask.sum()))
        inner = usable_records(times[good], {}, stream="gps", where=f"{self.where}, gps", drops=self.counter, limit=0.5)
        keep = good[inner]
        llh = llh[keep]
        plane = TangentPlane(*llh[0].tolist())
        enu = plane.from_ecef(geodetic_to_ecef(llh))
        P = np.tile(FIX_SIGMA**2 * np.eye(3), (len(keep), 1, 1))
        unknown = 0
        for k, row in enumerate(keep):
            stated, kind = values[row][1], values[row][3]
            S = 0.5 * (stated + stated.T)
            if kind > 0 and np.all(finite_mask(S)) and np.linalg.eigvalsh(S)[0] > 1e-6:
                P[k] = S
            else:
                unknown += 1
        self.counter.drop("gps", f"fix without a usable covariance: σ {FIX_SIGMA:g} m assumed (kept)", unknown)
        c = 2 if flat else 3
        place = self.frames.between(self.base, self.rows["gps"].frame)
        lever = np.zeros(3) if place is None else place[:3]
        sigma = np.sqrt(P[:, 0, 0])
        return Gps(times=times[keep], positions=enu[:, :c], sigma=sigma, lever=lever[:c], covariances=P[:, :c, :c])


def far_fixes(llh: Array, usable: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Mask of fixes ``(n,)`` that are far from all others: receivers report such positions before they have a solution.

    Parameters
    ----------
    llh : (n, 3)
        Latitude, longitude [deg], height [m].
    usable : (n,)
        Mask of the fixes that are compared.
    """
    far = np.zeros(len(llh), np.bool_)
    rows = np.flatnonzero(usable)
    if len(rows) < FEWEST_FIXES:
        return far
    x = geodetic_to_ecef(llh[rows])
    away = np.linalg.norm(x - np.median(x, axis=0), axis=1)
    far[rows] = away > max(FAR, 10.0 * float(np.quantile(away, 0.8)))
    return far
