"""Is this machine ready? Every package is imported for real, in a process of its own."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Literal

from graphslam.app.run.front_ends import front_end_names
from graphslam.io.catalog import cache_folder, data_roots

REQUIRED = {
    "gtsam": "gtsam",
    "numpy": "numpy",
    "scipy": "scipy",
    "scikit-image": "skimage",
    "trimesh": "trimesh",
    "numba": "numba",
    "matplotlib": "matplotlib",
    "pandas": "pandas",
    "small_gicp": "small_gicp",
}
OPTIONAL = {"open3d": "open3d", "kiss-icp": "kiss_icp", "libusb-package": "libusb_package"}


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the examination."""

    name: str
    state: Literal["ok", "missing", "absent"]
    detail: str


def examine() -> list[Finding]:
    """Python, packages, data roots, front ends; "absent" is an optional part that is not there."""
    found = [Finding("python", "ok", f"{platform.python_version()}, {os.cpu_count()} cores, {platform.system()}")]
    for name, module in REQUIRED.items():
        problem = _import_error(f"import {module}")
        found.append(_finding(name, problem, required=True, hint=f"pip install {name}"))
    hint = "pip install 'graphslam-submaps[lidar]'"
    for name, module in OPTIONAL.items():
        code = f"import {module}"
        if name == "open3d":  # with libusb loaded first, as the library does it
            code = "from graphslam.core.heavy import import_open3d; import_open3d()"
        found.append(_finding(name, _import_error(code), required=False, hint=hint))
    names = front_end_names()
    state: Literal["ok", "missing"] = "ok" if names else "missing"
    found.append(
        Finding("front ends", state, ", ".join(names) or "none registered: install the package (pip install -e .)")
    )
    for root in data_roots()[:-1]:
        found.append(Finding("data root", "ok" if root.is_dir() else "absent", str(root)))
    cache = cache_folder()
    found.append(Finding("data cache", "ok" if cache.is_dir() else "absent", f"{cache} (made by graphslam data fetch)"))
    return found


def _finding(name: str, problem: str, *, required: bool, hint: str) -> Finding:
    try:
        number = version(name)
    except PackageNotFoundError:
        number = "not installed"
    if not problem:
        return Finding(name, "ok", number)
    return Finding(name, "missing" if required else "absent", f"{number}: {problem}; {hint}")


def _import_error(code: str) -> str:
    """Last line of what an import says when it fails; a crash of the interpreter counts as well."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"import ended the interpreter with code {done.returncode}"
