"""Check the installation. Every package is imported in another process."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, packages_distributions, version
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from graphslam.app.run.front_ends import front_end_names
from graphslam.core.extras import EXTRAS
from graphslam.core.jit import compiled_code, compiled_folder, compiled_root, unwritable
from graphslam.io.catalog import cache_folder, data_roots

DISTRIBUTION = "graphslam-submaps"
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
    """Result of one check."""

    name: str
    state: Literal["ok", "missing", "conflict", "absent"]
    detail: str


def examine_installation() -> list[InstallCheck]:
    """Python, packages, extras with their purpose, front ends, folders; "absent" marks an optional part."""
    found = [InstallCheck("python", "ok", f"{platform.python_version()}, {os.cpu_count()} cores, {platform.system()}")]
    there = {name: all(find_spec(m) for m in e.modules) for name, e in EXTRAS.items()}
    wanted = {name: f":{module}" for name, module in REQUIRED.items()}
    wanted |= {f"extra {extra}": f"{extra}:{','.join(EXTRAS[extra].modules)}" for extra in there if there[extra]}
    problems = dict(zip(wanted, import_errors([*wanted.values()])))
    found += [_finding(name, problems[name]) for name in REQUIRED]
    for extra, e in EXTRAS.items():
        problem = problems.get(f"extra {extra}", "not installed")
        advice = f"{e.buys}: pip install 'graphslam-submaps[{extra}]' (about {e.size} MB)"
        detail = e.buys if not problem else advice if not there[extra] else f"{problem} ({e.buys})"
        found.append(InstallCheck(f"extra {extra}", "absent" if problem else "ok", detail))
    found += [*other_distributions(), *remains(site_packages())]
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
    found.append(_compiled())
    return found


def other_distributions() -> list[InstallCheck]:
    """Other installed distributions with an import package ``graphslam``: it is undefined which one is imported."""
    others = sorted({n for n in packages_distributions().get("graphslam", ()) if _plain(n) != DISTRIBUTION})
    return [
        InstallCheck(
            "import name",
            "conflict",
            f"{name} {version(name)} also installs a package graphslam: pip uninstall {name}, "
            f"then install {DISTRIBUTION} again",
        )
        for name in others
    ]


def _plain(name: str) -> str:
    return name.lower().replace("_", "-")


def site_packages() -> list[Path]:
    """Folders of installed packages on the import path."""
    return [Path(p) for p in sys.path if Path(p).name in ("site-packages", "dist-packages")]


def remains(folders: Sequence[Path]) -> list[InstallCheck]:
    """Folders that an uninstall left behind: without ``__init__.py`` they are imported as empty packages."""
    left = [f / name for f in folders for name in ("graphslam", "graphslam_frontends")]
    return [
        InstallCheck(
            "old install", "conflict", f"{folder} is left of an install before this one; delete it: rm -r {folder}"
        )
        for folder in left
        if folder.is_dir() and not (folder / "__init__.py").exists()
    ]


def _compiled() -> InstallCheck:
    """Compiled code: its folder and size."""
    folder, why = compiled_folder(), unwritable()
    if why:
        advice = "kernels are compiled at every start; make it writable, or set NUMBA_CACHE_DIR to a folder that is"
        return InstallCheck("compiled code", "absent", f"{folder}: {why}; {advice}")
    number, size = compiled_code()
    clear = "set by NUMBA_CACHE_DIR" if os.environ.get("NUMBA_CACHE_DIR") else "graphslam doctor --clear-compiled"
    return InstallCheck("compiled code", "ok", f"{compiled_root()}: {number} functions, {size / 1e6:.0f} MB ({clear})")


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


_TRIES = """
import importlib, os, sys, traceback
answers = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)
for word in sys.argv[1:]:
    said = ""
    extra, _, modules = word.partition(":")
    try:
        for module in modules.split(","):
            if extra:
                importlib.import_module("graphslam.core.extras").import_extra(module, extra)
            else:
                importlib.import_module(module)
    except BaseException as error:
        said = traceback.format_exception_only(error)[-1].strip().splitlines()[-1]
    print(said, file=answers, flush=True)
"""


def import_errors(wanted: list[str]) -> list[str]:
    """Import modules in another process; returns the last line of each error, empty if there is none.

    If a module ends the interpreter, this is an error too; the next modules are imported by another process.

    Parameters
    ----------
    wanted : list of str
        ``":module"``, or ``"extra:module,module"``.
    """
    found: list[str] = []
    while len(found) < len(wanted):
        command = [sys.executable, "-c", _TRIES, *wanted[len(found) :]]
        done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
        found += done.stdout.splitlines()
        if len(found) < len(wanted):
            found.append(f"import ended the interpreter with code {done.returncode}")
    return found
