"""Readers of single data sets, and what each recognises. Nothing heavy is imported here."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from graphslam.io.reader import Reader
from graphslam.io.recognise import first_rows, parse_numbers
from graphslam.io.source_probe import ReaderMatch, SourceProbe, plain_name


def _slsjf_maps(look: SourceProbe) -> ReaderMatch | None:
    found = [p for p in look.by_ending.get(".mat", []) if re.fullmatch(r"localmap_\d+\.mat", p.name)]
    if not found:
        return None
    return (
        ReaderMatch(f"{len(found)} local maps of 2D I-SLSJF")
        if look.path.is_dir()
        else ReaderMatch("a local map", "its folder")
    )


def _slsjf_network(look: SourceProbe) -> ReaderMatch | None:
    found = [p for p in look.by_ending.get(".mat", []) if b"clean_data" in look.head(p)[128:4096]]
    found += [p for p in look.by_ending.get(".mat", []) if p.name.lower().endswith("clean_data.mat") and p not in found]
    return ReaderMatch(f"odometry and observations of 2D I-SLSJF ({found[0].name})") if found else None


def _ufastslam(look: SourceProbe) -> ReaderMatch | None:
    found = look.named("ufastslam_observationdistance.txt")
    return ReaderMatch("detections of trees as UFastSLAM publishes them") if found and look.path.is_dir() else None


def _victoria_park(look: SourceProbe) -> ReaderMatch | None:
    laser = look.named("laser.txt")
    if laser is None or parse_numbers(look.head(laser)[:60].decode("latin-1").rpartition("\t")[0]) is None:
        return None
    if look.path.is_file() or look.named("drs.txt") is None:
        return ReaderMatch("LASER.txt of the ACFR", "the folder with DRS.txt, speed and steering, in it")
    return ReaderMatch("laser, speed and steering of the ACFR in the text form of Victoria Park (LASER.txt, DRS.txt)")


def _mrclam(look: SourceProbe) -> ReaderMatch | None:
    robots = [p for p in look.files if re.fullmatch(r"robot\d+_odometry\.dat", plain_name(p))]
    if not robots:
        return None
    text = f"UTIAS MRCLAM, {len(robots)} robots"
    if look.path.is_file() or len({p.parent for p in robots}) > 1:
        return ReaderMatch(text, "the one folder that holds Barcodes.dat and the files of its robots")
    if look.named("barcodes.dat") is None:
        return ReaderMatch(text, "Barcodes.dat beside them: which barcode is which landmark")
    return ReaderMatch(text)


def _plaza(look: SourceProbe) -> ReaderMatch | None:
    tables = [p for p in look.files if re.fullmatch(r".+_dr\.txt", plain_name(p))]
    tables = [p for p in tables if (r := first_rows(look, p)) and all(len(x) == 3 for x in r)]
    if not tables:
        return None
    prefix = plain_name(tables[0])[: -len("_dr.txt")]
    text = f"Plaza (range only), {tables[0].name}"
    if look.path.is_file() or look.named(f"{prefix}_td.txt") is None:
        return ReaderMatch(text, f"the folder with {prefix}_TD.txt, the ranges, in it")
    return ReaderMatch(text)


def _tagged(look: SourceProbe, tags: tuple[str, ...]) -> Path | None:
    return next((p for p in look.texts if look.lines(p, 1)[0].split()[0] in tags), None)


def _tuc(look: SourceProbe) -> ReaderMatch | None:
    path = _tagged(look, ("odom2", "loop"))
    return ReaderMatch(f"odometry and loop candidates of TU Chemnitz ({path.name})") if path else None


def _smartloc(look: SourceProbe) -> ReaderMatch | None:
    path = _tagged(look, ("odom3", "pseudorange3"))
    return ReaderMatch(f"odometry and pseudoranges of smartLoc ({path.name})") if path else None


def _kitti_gps(look: SourceProbe) -> ReaderMatch | None:
    path = next((p for p in look.texts if look.lines(p, 1)[0].split() == ["Time,X,Y,Z"]), None)
    return ReaderMatch(f"positions of KITTI as GTSAM ships them ({path.name})") if path else None


def _lidar_pack(look: SourceProbe) -> ReaderMatch | None:
    found = look.named("xyz_i16_planar.npy")
    return ReaderMatch("packed clouds (int16)") if found is not None and look.path.is_dir() else None


def _parts() -> Iterator[tuple[str, dict[str, int]]]:
    for k in range(1, 6):
        yield f"robot{k}", {"robot": k}


def _never(look: SourceProbe) -> ReaderMatch | None:
    """Recognises nothing: it is asked for by name."""
    return None


_IO = "graphslam_studies.io"
SLSJF_LOCAL_MAPS = Reader(
    "local maps of 2D I-SLSJF: localmap_1.mat, localmap_2.mat, …", f"{_IO}.slsjf:read_slsjf_local_maps", _slsjf_maps
)
UFASTSLAM_DETECTIONS = Reader(
    "detections of trees as UFastSLAM publishes them",
    f"{_IO}.victoria_park_published:read_ufastslam_detections",
    _ufastslam,
)
SLSJF_NETWORK = Reader(
    "odometry and observations of 2D I-SLSJF, a pose network: *clean_data.mat",
    f"{_IO}.victoria_park_published:read_slsjf_network",
    _slsjf_network,
)
MRCLAM = Reader(
    "UTIAS MRCLAM of any number: Robot<k>_Odometry.dat, Robot<k>_Measurement.dat, Barcodes.dat",
    f"{_IO}.mrclam:read_mrclam",
    _mrclam,
    dict(_parts()),
    preset="mrclam-dataset7",
)
PLAZA = Reader(
    "Plaza of any number, ranges to beacons: *_DR.txt, *_TD.txt, perhaps *_.mat",
    f"{_IO}.plaza:read_plaza",
    _plaza,
    preset="plaza1",
)
TUC = Reader("TU Chemnitz: lines odom2 and loop (a study reads it, run does not)", f"{_IO}.tuc:read_tuc", _tuc)
SMARTLOC = Reader("smartLoc: lines odom3 and pseudorange3", f"{_IO}.smartloc:read_smartloc", _smartloc)
KITTI_GPS = Reader("KITTI positions of GTSAM: Time,X,Y,Z", f"{_IO}.kitti_gps:read_kitti_gps", _kitti_gps)
LIDAR_PACK = Reader("packed clouds: xyz_i16_planar.npy", f"{_IO}.lidar_pack:read_lidar_pack", _lidar_pack)
SLSJF_OBSERVATIONS = Reader(
    "observations and identities of 2D I-SLSJF", f"{_IO}.victoria_park_published:read_slsjf_observations", _never
)
VICTORIA_PARK = Reader(
    "laser, speed and steering of a car as text of the ACFR: LASER.txt, DRS.txt, perhaps GPS.txt",
    f"{_IO}.victoria_park:read_victoria_park",
    _victoria_park,
    preset="victoria-park",
)
