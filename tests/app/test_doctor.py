"""What the examination of an installation finds, beside the packages (tests/app/cli/test_cli.py)."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graphslam.app import doctor


def test_another_distribution_with_this_import_name_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.other_distributions() == []
    home = tmp_path / "python_graphslam-0.0.17.dist-info"
    home.mkdir()
    (home / "METADATA").write_text("Metadata-Version: 2.1\nName: python-graphslam\nVersion: 0.0.17\n")
    (home / "RECORD").write_text("graphslam/__init__.py,,\ngraphslam/graph/graph.py,,\n")
    for file in (tmp_path / "graphslam/__init__.py", tmp_path / "graphslam/graph/graph.py"):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()  # importlib_metadata, where something imports it, leaves missing files out
    monkeypatch.syspath_prepend(tmp_path)
    (finding,) = doctor.other_distributions()
    assert finding.state == "conflict"
    assert "python-graphslam 0.0.17" in finding.detail
    assert "pip uninstall python-graphslam" in finding.detail


def test_what_an_old_install_left_is_found(tmp_path: Path) -> None:
    assert doctor.remains(doctor.site_packages()) == []
    (tmp_path / "graphslam" / "core" / "__pycache__").mkdir(parents=True)
    whole = tmp_path / "graphslam_frontends"
    whole.mkdir()
    (whole / "__init__.py").touch()
    (finding,) = doctor.remains([tmp_path])
    assert finding.state == "conflict"
    assert f"rm -r {tmp_path / 'graphslam'}" in finding.detail


def test_what_fails_is_reported_and_what_comes_after_it_is_tried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    texts = {
        "noisy": "print('noise'); import no_such_module",
        "ends": "import os; os._exit(7)",
        "leaves": "raise SystemExit",
    }
    for name, text in texts.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert doctor.import_errors([":json", ":noisy", ":ends", ":leaves", ":json"]) == [
        "",
        "ModuleNotFoundError: No module named 'no_such_module'",
        "import ended the interpreter with code 7",
        "SystemExit",
        "",
    ]


def test_compiled_code_is_shown_and_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Packages are not imported for it."""
    from graphslam.app.cli import app
    from graphslam.core import jit

    monkeypatch.setattr(doctor, "import_errors", lambda codes: [""] * len(codes))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    file = tmp_path / "graphslam" / "compiled" / "numba-0-python-3" / "core_1" / "f.1.nbc"
    file.parent.mkdir(parents=True)
    file.write_bytes(bytes(3_000_000))
    jit.unwritable.cache_clear()

    def line(*options: str) -> str:
        done = CliRunner().invoke(app, ["doctor", "--json", *options])
        assert done.exit_code == 0, done.output
        (row,) = [c for c in json.loads(done.stdout)["checks"] if c["check"] == "compiled code"]
        return row["detail"]

    assert line().startswith(f"{tmp_path / 'graphslam' / 'compiled'}: 1 functions, 3 MB")
    assert ": 0 functions, 0 MB" in line("--clear-compiled")
    assert not file.exists()


def test_a_conflict_is_a_line_and_exit_code_1(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture) -> None:
    from graphslam.app import cli

    found = [doctor.InstallCheck("import name", "conflict", "python-graphslam 1 …")]
    monkeypatch.setattr(doctor, "examine_installation", lambda: found)
    monkeypatch.setattr(sys, "argv", ["graphslam", "doctor"])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    assert caught.value.code == 1
    out, err = capfd.readouterr()
    assert "conflict" in out
    assert err == "graphslam: 1 installs are in conflict: import name\n"
