"""Each row of the table in CONTRIBUTING.md, "Extend the program": what the row names is enough to add one."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import graphslam as gs
from graphslam.app.folders.output_files import OutputFiles
from graphslam.app.run.layer import Layer, make_layer
from graphslam.app.run.run import Run
from graphslam.app.verdict import checks
from graphslam.app.verdict.figures import RunMetrics
from graphslam.core.findings import Finding
from graphslam.core.submap import Submap
from graphslam.io.readers import list_readers
from graphslam.join import registry as joining
from graphslam.join.order import join_sequential
from graphslam.solve import registry as solving
from graphslam.solve.batch import BatchSolver
from tests.reference.small_study import STUDY

ROOT = Path(__file__).resolve().parents[2]
Install = Callable[[str, str, str], None]


def test_every_row_of_the_table_has_a_test() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text().partition("## Extend the program")[2]
    rows = re.findall(r"^\| ([a-z -]+) \|", text, re.M)
    assert len(rows) > 8
    assert {f"test_add_{re.sub('[ -]', '_', row)}" for row in rows} == {
        n for n in globals() if n.startswith("test_add_")
    }


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Install:
    """Install a package of one module under an entry point, as ``pip`` would."""

    def installed(group: str, name: str, code: str) -> None:
        module = f"strange_{group}"
        (tmp_path / f"{module}.py").write_text(code)
        info = tmp_path / f"{module}-0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 0\n")
        (info / "entry_points.txt").write_text(f"[graphslam.{group}]\n{name} = {module}:Own\n")
        monkeypatch.syspath_prepend(tmp_path)
        list_readers.cache_clear()

    return installed


@pytest.fixture(scope="module")
def log() -> gs.SensorLog:
    return gs.simulate("landmark-field", preset="quick", seed=1)


@pytest.fixture(scope="module")
def run(log: gs.SensorLog) -> Run:
    return gs.run(log, frontend="ekf", config={"calibrate": {"use": "none"}}, progress=False)


@pytest.fixture(scope="module")
def side_offsets() -> dict[str, Any]:
    """What a new sensor and its factor do; in a process of its own, since registrations last."""
    code = "from tests.extend.side_offset_run import main; main()"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


def test_add_sensor(side_offsets: dict[str, Any]) -> None:
    """It is stored with the log, used whole, entered in the ledger once, tested, and corrects the map."""
    assert side_offsets["used"] == side_offsets["offered"] == side_offsets["read"] == 40
    assert 0.5 < side_offsets["chi2_per_dof"] < 2.0
    assert side_offsets["side_error"][0] < 0.5 * side_offsets["side_error"][1]
    assert "spent" in side_offsets["twice"] or "used" in side_offsets["twice"]


def test_add_factor(side_offsets: dict[str, Any]) -> None:
    """Its Jacobian is that of finite differences, and iSAM2 and the batch solver reach one optimum."""
    assert side_offsets["jacobian"] < 1e-6
    assert side_offsets["solvers_apart"] < 1e-4


def test_add_front_end(install: Install, log: gs.SensorLog, run: Run) -> None:
    install(
        "frontends",
        "own-ekf",
        "from graphslam_frontends.landmarks.ekf import Ekf\nclass Own(Ekf):\n    name = 'own-ekf'\n",
    )
    assert "own-ekf" in gs.front_ends()
    own = gs.run(log, frontend="own-ekf", config={"calibrate": {"use": "none"}}, progress=False)
    assert own.metric("path_rmse_aligned") < 2.0 * run.metric("path_rmse_aligned")  # other name, other preset


def test_add_reader(install: Install, tmp_path: Path) -> None:
    install(
        "readers",
        "wheel-text",
        "import numpy as np\n"
        "import graphslam as gs\n"
        "from graphslam.io.reader import Reader\n"
        "from graphslam.io.source_probe import ReaderMatch\n"
        "def read(path, *, track: float = 1.0):\n"
        "    t, left, right = np.loadtxt(path, skiprows=1).T\n"
        "    controls = gs.VelocityControls(times=t, speed=(left + right) / 2, yaw_rate=(right - left) / track)\n"
        "    return gs.SensorLog(name=path.stem, streams={'wheels': controls})\n"
        "def recognise(probe):\n"
        "    first = [probe.lines(p)[:1] for p in probe.texts]\n"
        "    return ReaderMatch('speeds of two wheels') if ['WHEELS'] in first else None\n"
        "Own = Reader('speeds of two wheels', f'{__name__}:read', recognise)\n",
    )
    (tmp_path / "drive.txt").write_text("WHEELS\n0.0 1.0 1.0\n0.5 1.0 1.2\n1.0 1.0 1.0\n")
    read = gs.load(tmp_path / "drive.txt", track=0.5)
    np.testing.assert_allclose(read["wheels"].yaw_rate, [0.0, 0.4, 0.0])
    list_readers.cache_clear()


def test_add_world(install: Install) -> None:
    install(
        "worlds",
        "own-field",
        "from graphslam.sim.landmark_field import landmark_field_preset, simulate_landmark_field\n"
        "def Own(preset, seed, changes):\n"
        "    return simulate_landmark_field(landmark_field_preset('quick', **changes), seed)\n",
    )
    assert "own-field" in gs.worlds()
    made = gs.simulate("own-field", seed=3)
    assert made.truth is not None


def test_add_writer(install: Install, run: Run, tmp_path: Path) -> None:
    install(
        "writers",
        "nodes",
        "import numpy as np\n"
        "from graphslam.app.export import Writer\n"
        "Own = Writer(lambda run, path, options: np.savetxt(path, run.map.node_poses), 'nodes.txt')\n",
    )
    out = gs.export(run, format="nodes", out=tmp_path / "nodes.txt")
    np.testing.assert_allclose(np.loadtxt(out), run.map.node_poses)


def test_add_solver(monkeypatch: pytest.MonkeyPatch, log: gs.SensorLog, run: Run) -> None:
    class Own(BatchSolver):
        calls = 0

        def solve_to_optimum(self) -> None:
            Own.calls += 1
            super().solve_to_optimum()

    monkeypatch.setitem(solving.SOLVERS, "own", Own)
    assert "own" in gs.solvers()
    own = gs.run(log, frontend="ekf", solver="own", config={"calibrate": {"use": "none"}}, progress=False)
    assert Own.calls
    np.testing.assert_allclose(own.map.node_poses, run.map.node_poses, atol=1e-5)


def test_add_map_joining_method(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    def own(submaps: list[Submap], **options: Any) -> Any:
        return join_sequential(submaps, **options)

    monkeypatch.setitem(joining.JOINERS, "own", own)
    assert "own" in gs.joiners()
    poses = [gs.join_submaps(run.submaps, name).poses for name in ("own", "eif-sequential")]
    np.testing.assert_allclose(*poses)


def test_add_check(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    def few(figures: RunMetrics) -> list[Finding]:
        n = figures.metrics["submaps"]
        return [Finding("look", "few-submaps", f"submaps: {n:g} [≥ 100] — too few.")] if n < 100 else []

    monkeypatch.setattr(checks, "CHECKS", [*checks.CHECKS, checks.Check(few, ("few-submaps",))])
    figures = RunMetrics.of_rows(run.report, run.metric_rows)
    assert [f.text for f in checks.run_findings(figures) if f.code == "few-submaps"] == [
        "submaps: 7 [≥ 100] — too few."
    ]


def test_add_map_layer(log: gs.SensorLog, tmp_path: Path) -> None:
    class Length(Layer):
        name = "length"

        def make(self, run: Run, *, log: Any = None, progress: bool = True) -> float:
            return float(run.map.trajectory.length())

        def write(self, made: float, folder: OutputFiles, run: Run) -> list[Path]:
            folder.write_json("length.json", {"length": made})
            return [folder.path / "length.json"]

        def draw(self, made: float, figures: Path, *, name: str) -> list[Path]:
            return []

    gs.run(log, frontend="ekf", out=tmp_path / "run", config={"calibrate": {"use": "none"}}, progress=False)
    made, files, _ = make_layer(tmp_path / "run", Length(), progress=False)
    assert json.loads(files[0].read_text())["length"] == made > 10.0


def test_add_study() -> None:
    """An object that is named by its module needs no installation; tests/studies/test_study.py runs it."""
    assert gs.find_study("tests.reference.small_study:STUDY") is STUDY


def test_files_and_functions_that_contributors_read_of_exist() -> None:
    found = 0
    for page in ("CONTRIBUTING.md", "docs/architecture.md"):
        text = (ROOT / page).read_text()
        for file in set(re.findall(r"`((?:graphslam|frontends|tests|docs)/[\w/.]+)`", text)):
            assert "NAME" in file or (ROOT / file).exists(), f"{page}: {file} does not exist"
        for file, names in re.findall(r"^\| `([\w/.]+\.py)`((?:,? `[\w.]+`)*) \|", text, re.M):
            source = (ROOT / file).read_text()
            for part in re.findall(r"\w+", names):
                found += 1
                assert re.search(rf"(def|class) {part}\b", source), f"{page}: {file} has no {part}"
    assert found > 12
