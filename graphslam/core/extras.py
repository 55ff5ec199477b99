"""Optional packages, and the extra of the distribution that contains each."""

from __future__ import annotations

import ctypes
import importlib
from dataclasses import dataclass
from types import ModuleType

from graphslam.core.errors import MissingExtraError


@dataclass(frozen=True, slots=True)
class Extra:
    """One extra: ``pip install 'graphslam-submaps[NAME]'``."""

    buys: str
    """What it enables."""
    modules: tuple[str, ...]
    """Modules that it must make importable."""
    size: int
    """Size in addition to the base install, including bytecode [MB]; measured with Python 3.11 on Linux."""


EXTRAS = {
    "surface": Extra(
        "triangle meshes of surfaces (map --surface), path planning on terrain", ("skimage", "trimesh"), 60
    ),
    "open3d": Extra("gs.to_open3d(run), Poisson surfaces", ("open3d",), 1020),
    "kiss-icp": Extra("front end kiss-icp: the odometry of KISS-ICP", ("kiss_icp",), 17),
    "ros": Extra("read and export bags of ROS 1 and ROS 2, MCAP; no ROS needed", ("rosbags", "mcap"), 45),
    "las": Extra("LAS and LAZ clouds", ("laspy", "lazrs"), 2),
    "live": Extra("run --live: the Rerun viewer during a run", ("rerun",), 670),
    "cluster": Extra("studies, joins and networks on a Dask cluster", ("distributed",), 40),
    "notebooks": Extra("the notebooks, in JupyterLab", ("jupyterlab", "ipywidgets", "nbclient"), 165),
}


def import_extra(module: str, need: str, *, where: str | None = None) -> ModuleType:
    """Import a package of an extra.

    Parameters
    ----------
    module : str
        Such as ``"rosbags.rosbag1"``.
    need : str
        Feature that needs the package: the beginning of the message.
    where : str, optional
        File that needs it.
    """
    package = module.partition(".")[0]
    extra = next(name for name, e in EXTRAS.items() if package in e.modules)
    try:
        if package == "open3d":
            return _open3d()
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        raise MissingExtraError(
            f"{need} needs {package}, which cannot be imported ({error})",
            where=where,
            wanted=f"pip install 'graphslam-submaps[{extra}]'",
        ) from error


def _open3d() -> ModuleType:
    """Open3D's wheel links to ``libusb-1.0.so.0``, which a stock Debian does not have. The pure-wheel package
    ``libusb-package`` contains that library; loading it first is sufficient, because the loader matches by SONAME.
    """
    try:
        return importlib.import_module("open3d")
    except ImportError as first:
        if "libusb" not in str(first):
            raise
    libusb_package = importlib.import_module("libusb_package")
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    return importlib.import_module("open3d")
