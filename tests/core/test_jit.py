"""Compiled code is kept in the user's cache folder: bounded, and never a reason for a run to end."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from graphslam.core import jit

KERNEL = """
from graphslam.core.jit import compiled_code, njit

@njit
def twice(x):
    return 2 * x

@njit(nogil=True)
def thrice(x):
    return 3 * x

if __name__ == "__main__":
    import sys
    print(twice(2), thrice(1.5), len(twice.stats.cache_hits), compiled_code()[0])
"""


def compile_kernel(folder: Path, **environment: str) -> tuple[str, str]:
    """What a process that compiles two functions of a module in the folder prints on stdout and stderr."""
    (folder / "kernel.py").write_text(KERNEL)
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    env |= {"XDG_CACHE_HOME": str(folder / "home"), **environment}
    done = subprocess.run([sys.executable, "kernel.py"], cwd=folder, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of compiled code, in an empty user's cache folder."""
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return jit.compiled_root()


def made(file: Path, size: int, age: float) -> Path:
    """A file that was written some seconds ago."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(bytes(size))
    os.utime(file, (time.time() - age,) * 2)
    return file


def test_code_is_compiled_once_and_kept_below_the_users_cache_folder(tmp_path: Path) -> None:
    assert compile_kernel(tmp_path) == ("4 4.5 0 2", "")
    assert compile_kernel(tmp_path) == ("4 4.5 1 2", "")
    files = list(tmp_path.rglob("*.nbc"))
    assert len(files) == 2
    assert all(f.is_relative_to(tmp_path / "home" / "graphslam" / "compiled") for f in files)
    assert not (tmp_path / "__pycache__").exists()


def test_copies_of_a_module_have_their_code_in_common(tmp_path: Path) -> None:
    for name, hits in (("one", 0), ("two", 1)):
        (tmp_path / name).mkdir()
        home = {"XDG_CACHE_HOME": str(tmp_path / "home")}
        assert compile_kernel(tmp_path / name, **home) == (f"4 4.5 {hits} 2", "")


def test_code_that_calls_what_has_changed_is_compiled_again(tmp_path: Path) -> None:
    """The called function, and a constant that it takes from a third file, are compiled into the code of the caller."""
    package = tmp_path / "graphslam_other"
    package.mkdir()
    callee = "from graphslam.core.jit import njit\nfrom graphslam_other.constant import C\n\n\n@njit\ndef plus(x):\n"
    (tmp_path / "caller.py").write_text(
        "from graphslam.core.jit import njit\nfrom graphslam_other.callee import plus\n\n\n"
        "@njit\ndef twice(x):\n    return 2 * plus(x)\n\n\nprint(twice(1), len(twice.stats.cache_hits))\n"
    )
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {"XDG_CACHE_HOME": str(tmp_path / "home")}

    def said(constant: int, body: str) -> str:
        (package / "constant.py").write_text(f"C = {constant}\n")
        (package / "callee.py").write_text(f"{callee}    return {body}\n")
        done = subprocess.run(
            [sys.executable, "-B", "caller.py"], cwd=tmp_path, env=env, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.strip()

    assert [said(1, "x + C"), said(1, "x + C"), said(1, "x + 2 * C"), said(55, "x + 2 * C"), said(1, "x + C")] == [
        "4 0", "4 1", "6 0", "222 0", "4 1",
    ]  # fmt: skip


def test_the_folder_that_numba_is_given_wins(tmp_path: Path) -> None:
    assert compile_kernel(tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "chosen")) == ("4 4.5 0 2", "")
    assert not (tmp_path / "home").exists()
    assert len(list((tmp_path / "chosen").rglob("*.nbc"))) == 2


def test_a_folder_that_cannot_be_written_costs_one_line(tmp_path: Path) -> None:
    (tmp_path / "home").write_text("a file where the folder should be")
    out, err = compile_kernel(tmp_path)
    assert out == "4 4.5 0 0"
    assert len(err.splitlines()) == 1
    assert "compiled code cannot be kept in" in err
    assert "NUMBA_CACHE_DIR" in err
    assert not list(tmp_path.rglob("*.nb?"))  # not beside the source either


def test_a_full_disk_costs_one_line(tmp_path: Path) -> None:
    code = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\nimport runpy\n"
    (tmp_path / "full.py").write_text(code + "runpy.run_path('kernel.py', run_name='__main__')")
    (tmp_path / "kernel.py").write_text(KERNEL)
    env = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {"XDG_CACHE_HOME": str(tmp_path / "home")}
    done = subprocess.run([sys.executable, "full.py"], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.stdout.strip() == "4 4.5 0 0", done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "File too large" in done.stderr


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_damaged_files_are_replaced(tmp_path: Path, suffix: str) -> None:
    compile_kernel(tmp_path)
    for file in tmp_path.rglob(f"*{suffix}"):
        file.write_bytes(b"\x80\x05no pickle")
    assert compile_kernel(tmp_path) == ("4 4.5 0 2", "")
    assert compile_kernel(tmp_path) == ("4 4.5 1 2", "")


def test_other_versions_go_after_a_month_without_use(root: Path) -> None:
    month = jit.UNUSED_SECONDS
    now, used, unused = (made(root / name / "core_1" / "f.1.nbc", 10, 2 * month) for name in ("now", "used", "unused"))
    os.utime(root / "unused", (time.time() - month - 60,) * 2)
    os.utime(root / "now", (time.time() - month - 60,) * 2)
    jit.trim_compiled_code(root, root / "now")
    assert now.exists()
    assert used.exists()
    assert not unused.exists()


def test_the_oldest_files_go_when_there_is_too_much(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "MOST_BYTES", 250)
    files = [made(root / "now" / "core_1" / f"f.{k}.nbc", 100, 1000.0 - k) for k in range(5)]
    jit.trim_compiled_code(root, root / "now")
    assert [f.exists() for f in files] == [False, False, False, True, True]
    jit.trim_compiled_code(root, root / "now")
    assert jit.compiled_code() == (2, 200)


def test_what_another_process_deletes_meanwhile_is_no_error(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jit, "MOST_BYTES", 0)
    kept = made(root / "now" / "core_1" / "f.1.nbc", 100, 0.0)
    monkeypatch.setattr(jit, "_files", lambda root: iter([(0.0, 50, root / "gone.nbc"), (1.0, 100, kept)]))
    jit.trim_compiled_code(root, root / "now")
    assert not kept.exists()
    jit.trim_compiled_code(root / "nothing", root / "now")


def test_all_versions_are_cleared_but_not_a_folder_of_the_user(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made(root / "one" / "f.1.nbc", 10, 0.0)
    own = made(root.parent / "own" / "f.1.nbc", 10, 0.0)
    jit.clear_compiled_code()
    assert jit.compiled_code() == (0, 0)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(own.parent))
    jit.clear_compiled_code()
    assert own.exists()


def test_a_function_that_only_kernels_call_has_no_file_and_runs_in_python(tmp_path: Path) -> None:
    (tmp_path / "called.py").write_text(
        "import gc\n"
        "from graphslam.core.jit import callee, compiled_code, njit\n\n\n"
        "@callee\ndef half(x):\n    return x / 2\n\n\n"
        "@njit\ndef quarter(x):\n    return half(half(x))\n\n\n"
        "print(quarter(8), half(8), compiled_code()[0], gc.isenabled())\n"
    )
    env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "home")}
    done = subprocess.run([sys.executable, "called.py"], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.stdout == "2.0 4.0 1 True\n", done.stderr
