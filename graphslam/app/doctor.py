"""Is this machine ready? Every package is imported for real, in a process of its own."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Literal

from graphslam.app.run.front_ends import front_end_names
from graphslam.core.extras import EXTRAS
from graphslam.io.catalog import cache_folder, data_roots

REQUIRED = {
    "gtsam": "gtsam",
    "numpy": "numpy",
    "scipy": "scipy",
    "numba": "numba",
    "matplotlib": "matplotlib",
    "pandas": "pandas",
    "small_gicp": "small_gicp",
}


@dataclass(frozen=True, slots=True)
class InstallCheck:
    """One line of the examination."""

    name: str
    state: Literal["ok", "missing", "absent"]
    detail: str


def examine_installation() -> list[InstallCheck]:
    """Python, packages, extras and what each buys, data roots, front ends; "absent" is an optional part."""
    found = [InstallCheck("python", "ok", f"{platform.python_version()}, {os.cpu_count()} cores, {platform.system()}")]
    for name, module in REQUIRED.items():
        problem = _import_error(f"import {module}")
        found.append(_finding(name, problem))
    for extra, e in EXTRAS.items():
        code = "from graphslam.core.extras import import_extra\n"
        code += "\n".join(f"import_extra({module!r}, {extra!r})" for module in e.modules)
        there = all(find_spec(module) for module in e.modules)
        problem = _import_error(code) if there else "not installed"
        advice = f"{e.buys}: pip install 'graphslam-submaps[{extra}]' (about {e.size} MB)"
        detail = e.buys if not problem else advice if not there else f"{problem} ({e.buys})"
        found.append(InstallCheck(f"extra {extra}", "absent" if problem else "ok", detail))
    names = front_end_names()
    state: Literal["ok", "missing"] = "ok" if names else "missing"
    found.append(
        InstallCheck("front ends", state, ", ".join(names) or "none registered: install the package (pip install -e .)")
    )
    for root in data_roots()[:-1]:
        found.append(InstallCheck("data root", "ok" if root.is_dir() else "absent", str(root)))
    cache = cache_folder()
    found.append(
        InstallCheck("data cache", "ok" if cache.is_dir() else "absent", f"{cache} (made by graphslam data fetch)")
    )
    return found


def _finding(name: str, problem: str) -> InstallCheck:
    try:
        number = version(name)
    except PackageNotFoundError:
        number = "not installed"
    return (
        InstallCheck(name, "missing", f"{number}: {problem}; pip install {name}")
        if problem
        else InstallCheck(name, "ok", number)
    )


def _import_error(code: str) -> str:
    """Last line of what an import says when it fails; a crash of the interpreter counts as well."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300, check=False)
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines else f"import ended the interpreter with code {done.returncode}"
