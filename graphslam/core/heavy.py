"""Import of optional heavy packages, with the system libraries they silently need."""

from __future__ import annotations

import ctypes
import importlib
from types import ModuleType

from graphslam.core.errors import GraphSlamError


def import_open3d() -> ModuleType:
    """Import Open3D on any machine, also on one without libusb and without root.

    The Open3D wheel links to ``libusb-1.0.so.0``, which a stock Debian does not have. The pure-wheel package
    ``libusb-package`` carries that library; loading it first satisfies the loader, because it matches by SONAME.

    Raises
    ------
    GraphSlamError
        If Open3D is not installed or still cannot be loaded; says what to install.
    """
    try:
        return importlib.import_module("open3d")
    except ImportError as first:
        if "libusb" not in str(first):
            raise GraphSlamError(
                f"Open3D cannot be imported ({first}); pip install 'graphslam-submaps[lidar]'"
            ) from first
    try:
        libusb_package = importlib.import_module("libusb_package")
        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        return importlib.import_module("open3d")
    except (ImportError, OSError) as error:
        raise GraphSlamError(
            f"Open3D needs libusb-1.0 ({error}); pip install libusb-package, or install the system package libusb-1.0-0"
        ) from error
