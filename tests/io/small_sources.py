"""Small files of every kind that a newcomer brings: one robot in one room, written as each format wants it.

The room is a box with a pillar, 12 × 8 × 3 m; the robot drives a bow in it. All clouds and scans are what it sees
from its poses, so that what is read can be held against them, and a front end can follow them.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from graphslam.core import se3

STEPS = 12
PERIOD = 0.1
T0 = 1_700_000_000.0


def poses(n: int = STEPS) -> np.ndarray:
    """Poses ``(n, 7)``: a bow to the left, slightly uphill."""
    heading = 0.05 * np.arange(n)
    x, y = np.cumsum(0.2 * np.cos(heading)) - 3.0, np.cumsum(0.2 * np.sin(heading)) - 1.0
    zero = np.zeros(n)
    return np.column_stack([x, y, 0.01 * np.arange(n), zero, zero, np.sin(heading / 2), np.cos(heading / 2)])


def walls(spacing: float = 0.25) -> np.ndarray:
    """Points ``(m, 3)`` of the room."""
    a = [np.arange(-w, w + 1e-9, spacing) for w in (6.0, 4.0, 1.5)]
    out = []
    for axis in range(3):
        u, v = (a[k] for k in range(3) if k != axis)
        g = np.array(np.meshgrid(u, v)).reshape(2, -1).T
        for side in (a[axis][0], a[axis][-1]):
            out.append(np.insert(g, axis, side, axis=1))
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    pillar = [np.column_stack([2 + 0.4 * np.cos(angle), 1.5 + 0.4 * np.sin(angle), np.full(12, z)]) for z in a[2]]
    return np.vstack([*out, *pillar])


def clouds(n: int = STEPS, spacing: float = 0.25) -> list[np.ndarray]:
    """What the robot sees at each pose, in its own frame; whole numbers of float32."""
    room, out = walls(spacing), []
    for pose in poses(n):
        back = se3.se3_inverse(pose[None])[0]
        seen = se3.quat_rotate(np.tile(back[3:], (len(room), 1)), room) + back[:3]
        out.append(seen.astype(np.float32).astype(np.float64))
    return out


def stamps(n: int = STEPS) -> np.ndarray:
    return T0 + PERIOD * np.arange(n)


def point_times(m: int) -> np.ndarray:
    """Seconds of each point from the begin of its scan."""
    return np.linspace(0.0, 0.09, m)


# ---- poses and stamps beside clouds ----------------------------------------------------------------------------------


def tum_table(path: Path, n: int = STEPS) -> None:
    rows = np.column_stack([stamps(n), poses(n)])
    np.savetxt(path, rows, fmt="%.9f", header="timestamp tx ty tz qx qy qz qw")


def kitti_table(path: Path, n: int = STEPS, T_camera_lidar: np.ndarray | None = None) -> None:
    """Poses as 3 × 4 matrices; those of a camera where the lidar's place in it is given."""
    p = poses(n)
    if T_camera_lidar is not None:
        p = se3.se3_compose(p, np.broadcast_to(se3.se3_inverse(T_camera_lidar[None])[0], p.shape))
    rows = np.concatenate([se3.quat_to_matrix(p[:, 3:]), p[:, :3, None]], axis=2).reshape(n, 12)
    np.savetxt(path, rows, fmt="%.9e")


# ---- clouds ----------------------------------------------------------------------------------------------------------


def write_bin(path: Path, xyz: np.ndarray) -> None:
    np.column_stack([xyz, np.zeros(len(xyz))]).astype("<f4").tofile(path)


def write_ply(path: Path, xyz: np.ndarray, *, ascii_: bool = False, times: bool = False) -> None:
    """PLY, binary or as text, with times of points or without."""
    form = "ascii" if ascii_ else "binary_little_endian"
    names = ["x", "y", "z"] + (["t"] if times else [])
    head = [f"ply\nformat {form} 1.0\ncomment a scan\nelement vertex {len(xyz)}"]
    head += [f"property float {c}" for c in names] + ["end_header\n"]
    table = np.column_stack([xyz, point_times(len(xyz))]) if times else xyz
    if ascii_:
        body = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in table).encode() + b"\n"
    else:
        body = table.astype("<f4").tobytes()
    path.write_bytes("\n".join(head).encode() + body)


def write_pcd(path: Path, xyz: np.ndarray, form: str = "binary") -> None:
    """PCD as PCL writes it: text, binary, or compressed field by field (LZF, here with literals only)."""
    n = len(xyz)
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {form}\n"
    ).encode()
    a = xyz.astype("<f4")
    if form == "ascii":
        body = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in a).encode() + b"\n"
    elif form == "binary":
        body = a.tobytes()
    else:
        plain = a.T.tobytes()
        packed = b"".join(bytes([len(c) - 1]) + c for c in (plain[k : k + 32] for k in range(0, len(plain), 32)))
        body = struct.pack("<II", len(packed), len(plain)) + packed
    path.write_bytes(head + body)


def write_las(path: Path, xyz: np.ndarray, begin: float = 0.0) -> None:
    """LAS or LAZ by ``laspy``, by the ending, with GPS times of the points."""
    import laspy

    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales, header.offsets = np.full(3, 1e-4), np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.gps_time = begin + point_times(len(xyz))
    las.write(str(path))


def cloud_folder(root: Path, ending: str, *, table: str = "", n: int = STEPS, spacing: float = 0.25) -> Path:
    """A folder of clouds: ``bin``, ``ply``, ``ply-ascii``, ``pcd``, ``pcd-ascii``, ``pcd-lzf``, ``las``, ``laz``.

    ``table`` is ``tum`` or ``kitti`` for poses beside them.
    """
    root.mkdir(parents=True, exist_ok=True)
    kind, _, form = ending.partition("-")
    for k, xyz in enumerate(clouds(n, spacing)):
        path = root / f"scan_{k}.{kind}"
        if kind == "bin":
            write_bin(path, xyz)
        elif kind == "ply":
            write_ply(path, xyz, ascii_=form == "ascii", times=form == "times")
        elif kind == "pcd":
            write_pcd(path, xyz, {"": "binary", "lzf": "binary_compressed"}.get(form, form))
        else:
            write_las(path, xyz, begin=stamps(n)[k])
    if table == "tum":
        tum_table(root / "poses.txt", n)
    elif table == "kitti":
        kitti_table(root / "poses.txt", n)
    return root


T_CAMERA_LIDAR = np.array([0.1, -0.2, -0.3, 0.5, -0.5, 0.5, 0.5])
"""Lidar in a camera that looks ahead: z of the camera is x of the lidar."""


def kitti_odometry(root: Path, n: int = STEPS) -> Path:
    """``velodyne/``, ``times.txt``, ``calib.txt`` and ``poses.txt`` of the camera."""
    (root / "velodyne").mkdir(parents=True)
    for k, xyz in enumerate(clouds(n)):
        write_bin(root / "velodyne" / f"{k:06d}.bin", xyz)
    np.savetxt(root / "times.txt", PERIOD * np.arange(n), fmt="%.6e")
    R = se3.quat_to_matrix(T_CAMERA_LIDAR[None, 3:])[0]
    row = np.column_stack([R, T_CAMERA_LIDAR[:3]]).ravel()
    (root / "calib.txt").write_text("P0: " + "0 " * 12 + "\nTr: " + " ".join(f"{v:.9e}" for v in row) + "\n")
    kitti_table(root / "poses.txt", n, T_CAMERA_LIDAR)
    return root


def kitti_raw(root: Path, n: int = STEPS) -> Path:
    """``velodyne_points/`` and ``oxts/`` with their stamps."""
    lines = [f"2011-09-26 13:02:{25 + PERIOD * k:012.9f}" for k in range(n)]
    for name in ("velodyne_points", "oxts"):
        (root / name / "data").mkdir(parents=True)
        (root / name / "timestamps.txt").write_text("\n".join(lines) + "\n")
    for k, (xyz, pose) in enumerate(zip(clouds(n), poses(n))):
        write_bin(root / "velodyne_points" / "data" / f"{k:010d}.bin", xyz)
        fix = [49.0 + pose[1] / 111_000.0, 8.4 + pose[0] / 73_000.0, 116.0 + pose[2]]
        row = [*fix, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 9.81, 0, 0, 9.81, 0, 0, 0.5, 0, 0, 0.5, 0.05, 0.01, 4, 10, 4, 4, 6]
        (root / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(f"{v:.12g}" for v in row) + "\n")
    return root


# ---- tables ----------------------------------------------------------------------------------------------------------

LANDMARKS = np.array([[4.0, 2.0], [3.0, -2.5], [-1.0, 3.0], [6.0, 0.5], [0.5, -3.0], [-4.0, 1.0]])


def drive(seconds: float = 40.0, rate: float = 10.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, speeds, yaw rates and poses of a robot on a figure of eight."""
    t = np.arange(int(seconds * rate)) / rate
    v, w = np.full(len(t), 0.5), 0.45 * np.sign(np.sin(2 * np.pi * t / 28.0) + 1e-9)
    pose = np.zeros((len(t), 3))
    for k in range(1, len(t)):
        middle = pose[k - 1, 2] + 0.5 * w[k - 1] / rate
        step = v[k - 1] / rate
        pose[k] = pose[k - 1] + [step * np.cos(middle), step * np.sin(middle), w[k - 1] / rate]
    return t, v, w, pose


def detections(t: np.ndarray, pose: np.ndarray, every: int = 4) -> np.ndarray:
    """Rows of stamp, number, range and bearing of what is in front and near."""
    rng, rows = np.random.default_rng(3), []
    for k in range(0, len(t), every):
        d = LANDMARKS - pose[k, :2]
        r, b = np.hypot(*d.T), np.arctan2(d[:, 1], d[:, 0]) - pose[k, 2]
        b = np.arctan2(np.sin(b), np.cos(b))
        for i in np.flatnonzero((r < 6.0) & (np.abs(b) < 2.0)):
            rows.append([t[k], i, r[i] + 0.03 * rng.standard_normal(), b[i] + 0.01 * rng.standard_normal()])
    return np.array(rows)


def tables(root: Path, *, seconds: float = 40.0, poses: bool = False, factor: dict[str, float] | None = None) -> Path:
    """``odometry.csv`` and ``observations.csv``; columns of ``factor`` are multiplied, which is a fault."""
    root.mkdir(parents=True, exist_ok=True)
    t, v, w, pose = drive(seconds)
    f = {"t": 1.0, "v": 1.0, "w": 1.0, "range": 1.0, "bearing": 1.0, **(factor or {})}
    if poses:
        np.savetxt(root / "odometry.csv", np.column_stack([t, pose]), delimiter=",", header="t,x,y,theta", comments="")
    else:
        rows = np.column_stack([f["t"] * t, f["v"] * v, f["w"] * w])
        np.savetxt(root / "odometry.csv", rows, delimiter=",", header="t [s],v [m/s],w [rad/s]", comments="")
    rows = detections(t, pose)
    rows[:, 0] *= f["t"]
    rows[:, 2] *= f["range"]
    rows[:, 3] *= f["bearing"]
    form = ("%.6f", "%d", "%.9g", "%.9g")
    np.savetxt(root / "observations.csv", rows, delimiter=",", fmt=form, header="t,id,range,bearing", comments="")
    return root


def planar_ranges(pose: np.ndarray, beams: np.ndarray) -> np.ndarray:
    """Ranges ``(m,)`` to the walls of the room in the plane."""
    a = pose[2] + beams
    c, s = np.cos(a), np.sin(a)
    with np.errstate(divide="ignore"):
        x = np.where(c > 0, (6.0 - pose[0]) / c, (-6.0 - pose[0]) / c)
        y = np.where(s > 0, (4.0 - pose[1]) / s, (-4.0 - pose[1]) / s)
    return np.minimum(np.abs(x), np.abs(y))


def carmen(path: Path, dialect: str = "ROBOTLASER1", n: int = 40, mixed: bool = False) -> Path:
    """A CARMEN log of one dialect; ``mixed``: every fifth scan has half the beams."""
    lines = ["# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp", "PARAM robot_x 1"]
    for k in range(n):
        t, pose = T0 + 0.2 * k, np.array([0.1 * k - 2.0, 0.0, 0.01 * k])
        m = 91 if mixed and k % 5 == 4 else 181
        beams = np.linspace(-np.pi / 2, np.pi / 2, m)
        seen = " ".join(f"{r:.3f}" for r in planar_ranges(pose, beams))
        at = f"{pose[0]:.6f} {pose[1]:.6f} {pose[2]:.6f}"
        end = f"{t:.6f} robot {t:.6f}"
        if dialect == "FLASER":
            lines.append(f"FLASER {m} {seen} {at} {at} {end}")
            continue
        head = f"{dialect} 0 {-np.pi / 2:.6f} {np.pi:.6f} {np.pi / (m - 1):.6f} 50.0 0.01 0 {m} {seen} 0"
        if dialect.startswith("RAWLASER"):
            lines += [f"ODOM {at} 0.5 0.05 0.0 {end}", f"{head} {end}"]
        else:
            lines.append(f"{head} {at} {at} 0.5 0.05 0.5 0.5 1e6 {end}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def euroc(root: Path, n: int = 200) -> Path:
    """``imu0`` and ``state_groundtruth_estimate0`` as the ASL writes them."""
    t = (1_403_636_579_000_000_000 + 5_000_000 * np.arange(n)).astype(np.int64)
    names = (
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    )
    truth = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [],"
        " v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"
    )
    for folder, head, row in (
        ("imu0", names, "{},0.0,0.0,0.1,9.81,0.0,0.2"),
        ("state_groundtruth_estimate0", truth, "{},1.0,2.0,3.0,1.0,0.0,0.0,0.0,0.0,0.0,0.0"),
    ):
        at = root / "mav0" / folder
        at.mkdir(parents=True)
        (at / "data.csv").write_text("\n".join([head, *(row.format(s) for s in t)]) + "\n")
    sheet = "gyroscope_noise_density: 1.7e-4\ngyroscope_random_walk: 1.9e-5\n"
    sheet += "accelerometer_noise_density: 2.0e-3\naccelerometer_random_walk: 3.0e-3\n"
    (root / "mav0" / "imu0" / "sensor.yaml").write_text(f"sensor_type: imu\n{sheet}")
    return root
