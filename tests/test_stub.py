"""``graphslam/__init__.pyi`` tells type checkers what ``import graphslam`` offers; it is written from the code.

``python -m tests.test_stub`` writes it anew.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import graphslam

STUB = Path(graphslam.__file__).with_suffix(".pyi")


def stub() -> str:
    """Text of the stub: an explicit import of every public name."""
    rooms = [f"from graphslam import {room} as {room}" for room in sorted(graphslam._ROOMS)]
    names = [f"from {graphslam._NAMES[n]} import {n} as {n}" for n in sorted(graphslam._NAMES)]
    head = "# Written by python -m tests.test_stub; tests/test_stub.py compares it with the code."
    return "\n".join([head, *rooms, *names, "", "__version__: str", ""])


def test_the_stub_holds_what_the_code_offers() -> None:
    assert STUB.read_text() == stub()
    assert STUB.with_name("py.typed").exists()


SCRIPT = """\
import graphslam as gs

reveal_type(gs.load)
reveal_type(gs.__version__)
run = gs.run("log", out="folder")
reveal_type(run)
reveal_type(run.metric("ate"))
reveal_type(gs.Submap)
reveal_type(gs.plots)
gs.no_such_name
"""


def test_a_type_checker_sees_the_types_of_a_users_script(tmp_path: Path) -> None:
    (tmp_path / "script.py").write_text(SCRIPT)
    cache = STUB.parents[1] / ".mypy_cache"
    command = [sys.executable, "-m", "mypy", "--follow-imports=silent", "--ignore-missing-imports"]
    command += ["--cache-dir", str(cache / "script"), "script.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    seen = re.findall(r'Revealed type is "(.*)"', done.stdout)
    assert len(seen) == 6, done.stdout + done.stderr
    assert "Any" not in [re.split(r"-> ", s)[-1] for s in seen]
    assert seen[1] == "str"
    assert seen[2] == "graphslam.app.run.run.Run"
    assert 'has no attribute "no_such_name"' in done.stdout


if __name__ == "__main__":
    STUB.write_text(stub())
