"""The documentation: its Python runs, its links lead somewhere, and it names options and files that there are."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from matplotlib import pyplot

from graphslam.backend.config import BackEndConfig
from graphslam_frontends.landmarks.config import RbpfEkfConfig

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted(p.relative_to(ROOT / "docs").as_posix() for p in (ROOT / "docs").rglob("*.md"))
MOST_WORDS = 1500  # of a page for users, without its code; measurements and derivations belong into docs/notes
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.M | re.S)
FENCED = re.compile(r"^```.*?^```$", re.M | re.S)
every_page = pytest.mark.parametrize("name", PAGES)


def page(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def anchor(heading: str) -> str:
    """GitHub's: lower case, no punctuation, hyphens for spaces."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


@every_page
def test_links_lead_somewhere(name: str) -> None:
    for target in re.findall(r"\]\(([^)]+)\)", page(name)):
        if target.startswith(("http://", "https://")):
            continue
        path, _, part = target.partition("#")
        page_file = ROOT / "docs" / name
        file = (page_file.parent / path).resolve() if path else page_file
        assert file.is_file(), f"{name}: {target}"
        if part:
            headings = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.M)
            assert part in {anchor(h) for h in headings}, f"{name}: {target}"


@pytest.mark.parametrize("name", [n for n in PAGES if not n.startswith("notes/")])
def test_page_for_users_is_short(name: str) -> None:
    words = len(FENCED.sub("", page(name)).split())
    assert words <= MOST_WORDS, f"{name}: {words} words; move measurements and derivations to docs/notes"


@pytest.mark.parametrize(
    "names",
    [
        ["concepts.md"],
        ["evidence-grids.md"],
        ["how-to.md", "own-front-end.md", "run-folder.md"],
        ["joiners.md"],
        ["live.md"],
        ["maps.md"],
        ["own-factor.md"],
        ["registration.md"],
        ["quick-start.md"],
        ["simulated-robots.md"],
        ["skeleton.md"],
        ["notes/skeleton.md"],
        ["steps.md"],
        ["without-truth.md"],
    ],
    ids=lambda names: names[0],
)
def test_python_of_the_page_runs_from_top_to_bottom(
    names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks that name a file are that file; the rest of the pages is one script, run in an empty folder.

    In this process, which has imported the package and loaded its kernels. A package that a page installs needs one of
    its own.
    """
    script = []
    for code in [code for name in names for code in BLOCK.findall(page(name))]:
        named = re.match(r"# file: (\S+)\n", code)
        if named:
            (tmp_path / named[1]).write_text(code, encoding="utf-8")
        else:
            script.append(code)
    assert script
    if "own-front-end.md" not in names:
        module = ModuleType("page")
        monkeypatch.setitem(sys.modules, "page", module)
        monkeypatch.chdir(tmp_path)
        exec(compile("\n".join(script), names[0], "exec"), module.__dict__)
        pyplot.close("all")
        return
    script.append(own_front_end(tmp_path))
    environment = {**os.environ, "MPLBACKEND": "Agg", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(script)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:]


def own_front_end(folder: Path) -> str:
    """Install the page's front end as its package would (an entry point), and what to run with it."""
    (toml,) = re.findall(r"^```toml\n\[project\.entry-points\..*?\]\n(.*?)^```$", page("own-front-end.md"), re.M | re.S)
    info = folder / "own-0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 0\n")
    (info / "entry_points.txt").write_text("[graphslam.frontends]\n" + toml.replace('"', ""))
    return """
from graphslam.core.gaussian import chi2_mean_bounds
one = gs.run("my-log", frontend="dead-reckoning", config={"frontend": {"seconds": 5.0}}, progress=False)
assert len(one.submaps) == 10, one
half = gs.run("my-log", frontend="dead-reckoning", out="half", progress=False)
resumed = gs.run("my-log", frontend="dead-reckoning", out="half", resume=True, progress=False)
assert np.array_equal(resumed.map.trajectory.poses, half.map.trajectory.poses)
nees = dof = 0.0  # a simulated log states its own noise
for seed in range(5):
    drive = gs.simulate("landmark-field", preset="quick", seed=seed)
    true = gs.run(drive, frontend="dead-reckoning", progress=False)
    nees, dof = nees + true.metric("nees"), dof + true.metric("nees_dof")
low, high = chi2_mean_bounds(dof, 1, 0.999)
assert 0.5 < low / dof < high / dof < 2.0, (low, high, dof)  # half or twice the covariance is told
assert low < nees < high, (low, nees, high)
"""


def test_options_of_the_how_to_exist_with_the_values_it_gives() -> None:
    rows = re.findall(r"^\| `((?:frontend|backend)\.[\w.]+)`(?:, `\.(\w+)`)? \| ([^|]+) \|", page("how-to.md"), re.M)
    assert len(rows) >= 7
    roots = {"frontend": RbpfEkfConfig(), "backend": BackEndConfig()}
    for key, second, stated in rows:
        first, *rest = key.split(".")
        for option in [rest, [*rest[:-1], second]] if second else [rest]:
            value = roots[first]
            for part in option:
                value = getattr(value, part)
            if not second:
                assert float(value) == (0.0 if stated.strip() == "false" else float(stated)), key


def test_run_folder_holds_the_files_that_the_page_names(tmp_path: Path) -> None:
    import graphslam as gs

    table = page("run-folder.md").split("## The run folder")[1].split("## ")[0]
    named = set(re.findall(r"`([\w.]+\.(?:toml|json|npz|tum|csv|g2o|jsonl|html))`", table))
    log = gs.simulate("landmark-field", preset="quick", gps_rate=1.0, gps_sigma=0.3)
    options = {"gps": {"use": "every-second"}}  # so that every file is there that a run can have
    run = gs.run(log, out=tmp_path / "run", progress=False, solver="batch", config=options)
    there = {p.name for p in run.folder.iterdir() if p.is_file() and p.name != ".lock"}
    assert named == there | {"draws.json"}  # there only where particles were drawn anew


def test_commands_and_python_of_the_readme_run_in_order_in_a_fresh_clone(tmp_path: Path) -> None:
    """As they stand there, but for time: the demo and the mixed world are the quick ones, the tests are only named, and
    the environment with the package is the one that runs this test. A demo is gone on with, to the same map."""
    clone, venv = tmp_path / "clone", tmp_path / "clone" / ".venv"
    subprocess.run(["git", "clone", "-q", "--no-local", str(ROOT), str(clone)], check=True)
    for name in subprocess.check_output(["git", "ls-files", "-mo", "--exclude-standard"], cwd=ROOT, text=True).split(
        "\n"
    ):
        if name and (ROOT / name).is_file():  # what is not committed yet
            (clone / name).parent.mkdir(parents=True, exist_ok=True)
            (clone / name).write_bytes((ROOT / name).read_bytes())
    venv.mkdir()
    (venv / "bin").symlink_to(Path(sys.executable).parent)
    for stamp in (".base", ".ready"):
        (venv / stamp).touch()
    text = (clone / "README.md").read_text(encoding="utf-8")
    commands = "\n".join(re.findall(r"^```sh\n(.*?)^```$", text, re.M | re.S))
    assert commands.splitlines()[0].startswith("make demo ")
    assert "graphslam simulate mixed --out " in commands
    for plain, quick in (
        ("make demo ", 'make demo DEMO="--preset quick" '),
        ("make test ", "make -n test "),
        ("graphslam simulate mixed ", "graphslam simulate mixed --preset quick "),
    ):
        commands = commands.replace(plain, quick)
    (python,) = BLOCK.findall(text)
    script = f"set -e\n{commands}\npython - <<'END'\n{python}\nEND\n"
    script += "cp demo-run/map.ply before.ply\ngraphslam demo --preset quick --out demo-run --json >again.json\n"
    # PYTHONSAFEPATH: `python -` would take the package of the clone
    environment = {**os.environ, "MPLBACKEND": "Agg", "OPENBLAS_NUM_THREADS": "1", "PYTHONSAFEPATH": "1"}
    done = subprocess.run(
        ["bash", "-c", script], cwd=clone, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-3000:]
    for made in ("runs/field/report.html", "runs/field/path.tum"):
        assert (clone / made).is_file(), made
    demo = clone / "demo-run"
    figures = {p.name for p in (demo / "figures").glob("*.png")}
    assert {"map.png", "fused_level0.png", "fused_above.png", "fused_cut.png"} <= figures
    assert {"report.html", "map.ply", "map.bt", "map-level0.pgm", "run.json"} <= {p.name for p in demo.iterdir()}
    assert "progress.png" not in figures
    assert "map_entropy" in done.stdout
    assert str(Path("demo-run") / "figures" / "progress.png") in done.stderr
    assert json.loads((clone / "again.json").read_text())["report"]["resumed_submaps"] > 2
    assert (demo / "map.ply").read_bytes() == (clone / "before.ply").read_bytes()


@every_page
def test_page_is_in_the_table_of_contents_of_the_site(name: str) -> None:
    """Else `make docs` fails."""
    assert re.search(rf"\b{re.escape(name)}$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M)
