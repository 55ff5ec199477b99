"""Reader of EuRoC recordings of a flying robot, without cameras: IMU, and prism positions from a total station.

* ``imu``: angular rates and specific forces. Noise densities, times ``noise_scale``, and random walks are from
  ``sensor.yaml``, which does not contain the initial σ of the biases.
* ``leica``: positions of the prism; its position on the body is the lever arm. The station has another clock than the
  IMU; ``late`` is subtracted from its stamps.

Stamps are seconds since the first IMU reading.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np

from graphslam.core import se3
from graphslam.core.errors import ConfigError, FormatError, MissingDataError
from graphslam.core.geometry import Array
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.records import Gps, Stream
from graphslam.core.trajectory import Trajectory
from graphslam.io.clock import usable_records
from graphslam.io.recognise import euroc_tables, parse_numbers
from graphslam.io.source_probe import SourceProbe
from graphslam.io.text_records import find_text_file, read_table

GYRO_BIAS, FORCE_BIAS = 0.1, 0.3
"""Assumed initial σ of the biases [rad/s, m/s²]."""
_DENSITIES = {
    "gyro": "gyroscope_noise_density",
    "gyro_walk": "gyroscope_random_walk",
    "accelerometer": "accelerometer_noise_density",
    "accelerometer_walk": "accelerometer_random_walk",
}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def read_euroc(
    folder: str | os.PathLike[str],
    *,
    sigma: float = 0.01,
    late: float = 0.0,
    noise_scale: float = 1.0,
) -> SensorLog:
    """Read the log.

    Parameters
    ----------
    folder : path
        Contains ``imu0/data.csv`` and ``imu0/sensor.yaml`` (or ``imu0_data.csv`` and ``imu0_sensor.yaml``), optionally
        the same for ``leica0``, and a table of poses (``state_groundtruth_estimate0``, ``vicon0``); tables may be
        compressed and in subfolders.
    sigma : float
        Assumed σ of each coordinate of a position [m].
    late : float
        Subtracted from the stamps of the positions [s].
    noise_scale : float
        Factor on the noise densities of ``sensor.yaml``; not on random walks.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted="the folder of a EuRoC recording")
    if not (sigma > 0 and noise_scale > 0 and np.isfinite([sigma, late, noise_scale]).all()):
        raise ConfigError(f"sigma = {sigma}, late = {late}, noise_scale = {noise_scale}; wanted σ and scale above 0")
    counter = DropCounter()
    tables = euroc_tables(SourceProbe(root))
    a_file = tables.get("imu") or find_text_file(root, "imu0_data.csv")
    sheet = _sheet(a_file)
    stated = read_text(sheet)
    density = {k: _number(stated, word, sheet) for k, word in _DENSITIES.items()}
    noise = ImuNoise(
        gyro=noise_scale * density["gyro"],
        gyro_bias=GYRO_BIAS,
        gyro_walk=density["gyro_walk"],
        accelerometer=noise_scale * density["accelerometer"],
        accelerometer_bias=FORCE_BIAS,
        accelerometer_walk=density["accelerometer_walk"],
    )
    a = _table(a_file, 7, "imu", counter)
    start = a[0][0, 0]
    streams: dict[str, Stream] = {
        "imu": Imu(
            times=1e-9 * (a[0][:, 0] - start), angular_rate=a[0][:, 1:4], specific_force=a[0][:, 4:], noise=noise
        )
    }
    read = {"imu": a[1]}
    station = tables.get("leica") or _there(root, "leica0_data.csv")
    if station is not None:
        z = _table(station, 4, "leica", counter)
        prism = _matrix(_sheet(station))[:3, 3]
        at = 1e-9 * (z[0][:, 0] - start) - late
        streams["leica"] = Gps(times=at, positions=z[0][:, 1:], sigma=np.full(len(z[0]), sigma), lever=prism)
        read["leica"] = z[1]
    for kind in ("truth", "vicon"):
        if kind in tables and "reference" not in streams:
            rows, n = _reference(tables[kind], counter)
            quat = se3.quat_normalize(rows[:, [5, 6, 7, 4]])
            streams["reference"] = Trajectory(1e-9 * (rows[:, 0] - start), np.column_stack([rows[:, 1:4], quat]))
            read["reference"] = n
    return SensorLog(
        name="euroc",
        streams=streams,
        read=read,
        dropped=dict(counter.counts),
        meta={"source": root.name, "sigma": sigma, "late": late, "noise_scale": noise_scale},
    )


def _there(root: Path, name: str) -> Path | None:
    try:
        return find_text_file(root, name)
    except MissingDataError:
        return None


def _sheet(table: Path) -> Path:
    """The ``sensor.yaml`` of a table: ``imu0_sensor.yaml`` for ``imu0_data.csv``, or in the same folder."""
    return table.with_name(table.name.partition("data.csv")[0] + "sensor.yaml")


def _reference(path: Path, counter: DropCounter) -> tuple[Array, int]:
    """Usable rows of stamp, position and quaternion (w first), and the number of all rows."""
    lines = [s for s in read_text(path).splitlines() if s.strip() and not s.startswith("#")]
    rows = [parse_numbers(s) or [] for s in lines]
    table = np.array([r[:8] if len(r) >= 8 else [np.nan] * 8 for r in rows]).reshape(-1, 8)
    norm = np.linalg.norm(np.where(finite_mask(table[:, 4:]), table[:, 4:], 0.0), axis=1)
    bad = {
        "a number is not finite": np.asarray(~finite_mask(table[:, 1:]).all(axis=1)),
        "rotation is no unit quaternion": np.abs(norm - 1.0) > 0.01,
    }
    keep = usable_records(table[:, 0], bad, stream="reference", where=str(path), drops=counter)
    return table[keep], len(table)


def _table(path: Path, columns: int, stream: str, counter: DropCounter) -> tuple[Array, int]:
    """Usable rows, and the number of all rows."""
    table, _ = read_table(path, columns, separator=",")
    bad = {"a number is not finite": np.asarray(~finite_mask(table[:, 1:]).all(axis=1))}
    keep = usable_records(table[:, 0], bad, stream=stream, where=str(path), drops=counter)
    return table[keep], len(table)


def _number(text: str, word: str, path: Path) -> float:
    found = re.search(rf"^{word}:\s*({_NUMBER})", text, re.MULTILINE)
    if found is None:
        raise FormatError(f"states no {word}", where=str(path), wanted=f"{word}: a number")
    return float(found[1])


def _matrix(path: Path) -> Array:
    """``T_BS`` ``(4, 4)`` of a ``sensor.yaml``."""
    found = re.search(r"data:\s*\[([^\]]{1,2000})\]", read_text(path))
    numbers = re.findall(_NUMBER, found[1]) if found else []
    T = np.array([float(x) for x in numbers])
    if len(T) != 16 or not np.all(finite_mask(T)):
        raise FormatError("holds no place of the sensor", where=str(path), got=f"{len(T)} numbers", wanted="16")
    return T.reshape(4, 4)
