"""Install, run, uninstall and install again, in an environment of its own: no step leaves what breaks the next one.

Dependencies are those of the environment that runs the tests, so nothing is downloaded.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"graphslam/": "graphslam/", "frontends/graphslam_frontends/": "graphslam_frontends/"}
CARDS = "datasets/", "graphslam/cards/"


def run(*command: str | Path, cwd: Path, python: Path | None = None, compiled: bool = True) -> str:
    """Output of a command that must succeed; Python sees the packages of its environment and nothing else."""
    env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
    env["XDG_CACHE_HOME"] = str(cwd / "cache")
    env |= {} if compiled else {"NUMBA_DISABLE_JIT": "1"}  # a small run takes less time than compiling for it
    words = [str(c) for c in ([python, *command] if python else command)]
    done = subprocess.run(words, cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.returncode == 0, f"{' '.join(words)}\n{done.stdout}"
    return done.stdout


def tracked() -> list[str]:
    """Files of the repository, relative to its root."""
    done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        pytest.skip("not a clone: the files of the repository are not known")
    return [f for f in done.stdout.split("\0") if f and (ROOT / f).is_file()]


@pytest.fixture(scope="module")
def clone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files of the repository, which bears the name of the package."""
    root = tmp_path_factory.mktemp("parent") / "graphslam"
    for name in tracked():
        target = root / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, target)
    return root


@pytest.fixture(scope="module")
def built(clone: Path) -> tuple[Path, Path]:
    """Wheel and sdist of the clone."""
    out = clone.parent / "dist"
    pytest.importorskip("hatchling")
    output = run("-m", "hatchling", "build", "-d", out, cwd=clone, python=Path(sys.executable))
    assert "warn" not in output.lower()
    (wheel,), (sdist,) = out.glob("*.whl"), out.glob("*.tar.gz")
    return wheel, sdist


def test_wheel_and_sdist_hold_the_files_of_the_packages(built: tuple[Path, Path]) -> None:
    with zipfile.ZipFile(built[0]) as wheel, tarfile.open(built[1]) as sdist:
        in_wheel, in_sdist = set(wheel.namelist()), set(sdist.getnames())
    wanted = set()
    for name in tracked():
        for here, there in {**PACKAGES, CARDS[0]: CARDS[1]}.items():
            if name.startswith(here) and name != "datasets/README.md":
                wanted.add(there + name.removeprefix(here))
    assert {"graphslam/py.typed", "graphslam/__init__.pyi", "graphslam_frontends/__init__.py"} <= wanted
    assert any(n.endswith(".toml") for n in wanted)
    held = {n for n in in_wheel if ".dist-info/" not in n}
    assert held == wanted
    top = built[1].name.removesuffix(".tar.gz")
    assert {f"{top}/{n}" for n in tracked() if n.startswith(("graphslam/", "frontends/", "datasets/"))} <= in_sdist


@pytest.fixture(scope="module")
def environment(clone: Path) -> Path:
    """A new virtual environment that sees the dependencies that are installed here, but no graphslam."""
    home, shared = clone.parent / "environment", clone.parent / "dependencies"
    venv.create(home, symlinks=True)
    shared.mkdir()
    for folder in (Path(p) for p in sys.path if Path(p).name == "site-packages"):
        for entry in folder.iterdir():
            if "graphslam" not in entry.name and entry.suffix != ".pth" and not (shared / entry.name).exists():
                (shared / entry.name).symlink_to(entry)
    (site,) = home.glob("lib/python3*/site-packages")
    (site / "dependencies.pth").write_text(f"{shared}\n")
    return home


def installed(environment: Path) -> set[str]:
    """What of this package is in an environment."""
    (site,) = environment.glob("lib/python3*/site-packages")
    return {p.name for p in site.iterdir() if "graphslam" in p.name}


def test_install_run_uninstall_and_editable_install(built: tuple[Path, Path], environment: Path, clone: Path) -> None:
    parent, python, command = clone.parent, environment / "bin" / "python", environment / "bin" / "graphslam"
    pip = ("-m", "pip", "--disable-pip-version-check")
    install = (*pip, "install", "--no-deps", "--no-index", "--no-build-isolation")

    run(*install, built[0], cwd=parent, python=python)
    assert {"graphslam", "graphslam_frontends"} <= installed(environment)
    world = "simulate", "landmark-field", "--preset", "quick"
    assert "s written to log" in run(command, *world, "--out", "log", cwd=parent)
    made = run(command, "run", "log", "--frontend", "ekf", "--out", "run", "--json", "-q", cwd=parent, compiled=False)
    assert json.loads(made)["report"]["converged"]
    assert (parent / "run" / "report.html").stat().st_size > 0
    kernel = (
        "from graphslam.graph.normal_kernels import inverse_left_jacobian_kernel; inverse_left_jacobian_kernel(0.1)"
    )
    run("-c", kernel, cwd=parent, python=python)

    run(*pip, "uninstall", "--yes", "graphslam-submaps", cwd=parent, python=python)
    assert installed(environment) == set()  # compiled code is in the user's cache folder
    assert list((parent / "cache" / "graphslam" / "compiled").rglob("*.nbc"))

    run(*install, "--editable", clone, cwd=parent, python=python)
    assert run(command, "--version", cwd=parent) == run("-m", "graphslam", "--version", cwd=clone, python=python)
    (parent / "script.py").write_text("import graphslam\nprint(graphslam.__file__, graphslam.simulate.__name__)\n")
    for folder in (parent, clone):  # the clone itself would be an empty package for whoever stands in its parent
        output = run(parent / "script.py", cwd=folder, python=python)
        assert output.split() == [str(clone / "graphslam" / "__init__.py"), "simulate"]
    checks = json.loads(run(command, "doctor", "--json", cwd=parent))["checks"]
    assert {c["state"] for c in checks} <= {"ok", "absent"}
