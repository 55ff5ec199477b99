"""KITTI positions as the examples of GTSAM ship them: fixes in local metres, one a second, and the IMU's data sheet.

* ``gps``: positions x east, y north, z up [m]. No σ is stated; GTSAM's own example takes 0.07 m.
* ``imu``, where ``KittiEquivBiasedImu.txt`` is there as well: rates and forces, with the noise of the metadata file.

Stamps are seconds since the first fix.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from graphslam.core.errors import ConfigError, FormatError, MissingDataError
from graphslam.core.imu import Imu, ImuNoise
from graphslam.core.log import DropCounter, SensorLog
from graphslam.core.reading import finite_mask, read_text
from graphslam.core.records import Gps
from graphslam.io.clock import usable_records
from graphslam.io.text_records import find_text_file, read_table

FIXES, READINGS, SHEET = "KittiGps_converted.txt", "KittiEquivBiasedImu.txt", "KittiEquivBiasedImu_metadata.txt"
SIGMA = 0.07
"""Of a coordinate of a fix [m], as in GTSAM's example; the file states none."""
_COLUMNS = "BodyPtx BodyPty BodyPtz BodyPrx BodyPry BodyPrz AccelerometerSigma GyroscopeSigma IntegrationSigma"
_COLUMNS += " AccelerometerBiasSigma GyroscopeBiasSigma AverageDeltaT"


def read_kitti_gps(
    folder: str | os.PathLike[str],
    *,
    sigma: float = SIGMA,
    name: str = "gtsam-kitti-gps",
    drops: DropCounter | None = None,
) -> SensorLog:
    """Read the log.

    Parameters
    ----------
    sigma : float
        Of a coordinate of a fix [m].
    name : str
        Of the log.
    drops : DropCounter, optional
        Counts into this one, besides ``SensorLog.dropped``.
    """
    root = Path(folder)
    if not root.is_dir():
        raise MissingDataError("no such folder", where=str(root), wanted=f"a folder that holds {FIXES}")
    if not (sigma > 0 and np.isfinite(sigma)):
        raise ConfigError(f"sigma = {sigma}; wanted above 0")
    counter = DropCounter()
    path = find_text_file(root, FIXES)
    table = _rows(path, "Time,X,Y,Z", 4, ",")
    bad = {"position is not finite": np.asarray(~finite_mask(table[:, 1:]).all(axis=1))}
    keep = usable_records(table[:, 0], bad, stream="gps", where=str(path), drops=counter)
    fixes = table[keep]
    start = fixes[0, 0]
    gps = Gps(times=fixes[:, 0] - start, positions=fixes[:, 1:], sigma=np.full(len(fixes), sigma), lever=np.zeros(3))
    streams: dict[str, Gps | Imu] = {"gps": gps}
    read = {"gps": len(table)}
    try:
        readings = find_text_file(root, READINGS)
    except MissingDataError:
        pass
    else:
        streams["imu"], read["imu"] = _imu(root, readings, start, counter)
    if drops is not None:
        drops.counts.update(counter.counts)
    return SensorLog(
        name=name,
        streams=streams,
        read=read,
        dropped=dict(counter.counts),
        meta={"source": root.name, "sigma": sigma},
    )


def _rows(path: Path, header: str, columns: int, separator: str | None) -> np.ndarray:
    """The numbers below one line of names."""
    text = read_text(path)
    first = text.partition("\n")[0]
    if first.split() != header.split():
        raise FormatError("begins with other columns", where=str(path), got=first[:80], wanted=header)
    return read_table(path, columns, separator=separator, skip=1)[0]


def _imu(root: Path, path: Path, start: float, counter: DropCounter) -> tuple[Imu, int]:
    sheet = find_text_file(root, SHEET)
    values = _rows(sheet, _COLUMNS, 12, None)
    if len(values) != 1 or not np.all(finite_mask(values)) or np.any(values[0, 6:] < 0):
        raise FormatError("is no data sheet", where=str(sheet), got=values.shape, wanted="one line of 12 numbers")
    s = dict(zip(_COLUMNS.split(), values[0].tolist()))
    if any(s[f"BodyP{c}"] for c in ("tx", "ty", "tz", "rx", "ry", "rz")):
        raise FormatError("the IMU is not at the body", where=str(sheet), got=values[0, :6], wanted="zeros")
    a = _rows(path, "Time dt accelX accelY accelZ omegaX omegaY omegaZ", 8, None)
    bad = {"reading is not finite": np.asarray(~finite_mask(a[:, 2:]).all(axis=1))}
    keep = usable_records(a[:, 0], bad, stream="imu", where=str(path), drops=counter)
    noise = ImuNoise(
        gyro=s["GyroscopeSigma"],
        gyro_bias=0.01,
        gyro_walk=s["GyroscopeBiasSigma"],
        accelerometer=s["AccelerometerSigma"],
        accelerometer_bias=0.1,
        accelerometer_walk=s["AccelerometerBiasSigma"],
    )
    return Imu(times=a[keep, 0] - start, angular_rate=a[keep, 5:], specific_force=a[keep, 2:5], noise=noise), len(a)
