"""The mutation check itself, on the modules whose tests take a second; and that it finds what it should."""

from __future__ import annotations

import subprocess
import sys
import tomllib

from tests.mutation.check import HERE, ROOT, draw
from tests.mutation.operators import mutants

SMALL = '''
def area(a, b=2.0):
    """A docstring."""
    if a <= 0 and b:
        raise ValueError(f"no area of {a}")
    total += a[1:] * b.T
    return float(max(total, 0))
'''


def test_changes_of_a_small_function() -> None:
    found = {(m.function, m.new) for m in mutants(SMALL)}
    for new in (
        "def area(a, b=1.0):",
        "def area(a, b=4.0):",
        "if a < 0 and b:",
        "if a > 0 and b:",
        "if a <= 0 or b:",
        "pass",
        "total += a[2:] * b.T",
        "total += a[0:] * b.T",
        "total += a[1:] / b.T",
        "total += a[1:] * b",
        "total -= a[1:] * b.T",
        "return float(min(total, 0))",
    ):
        assert ("area", new) in found, new
    assert len(found) == len(mutants(SMALL)) - 1  # raise and += both become pass
    assert not any("docstring" in m.old or "f'" in m.new for m in mutants(SMALL))


def test_a_draw_covers_the_functions_and_is_the_same_for_the_same_seed() -> None:
    file = "graphslam/evaluate/gauge.py"
    found = [(file, m) for m in mutants((ROOT / file).read_text())]
    a, b, c = draw(found, 14, 1), draw(found, 14, 1), draw(found, 14, 2)
    assert [m for _, m in a] == [m for _, m in b] != [m for _, m in c]
    assert len({m.source for _, m in a}) == 14
    assert {m.function for _, m in a} == {m.function for _, m in found}


def test_listed_equivalents_are_changes_that_can_be_made() -> None:
    """A line of the program that is edited takes its entries with it."""
    listed = tomllib.loads((HERE / "equivalent.toml").read_text())["equivalent"]
    keys = [(e["file"], e["function"], e["old"], e["new"]) for e in listed]
    assert len(set(keys)) == len(keys)
    assert all(len(e["reason"].split()) > 4 for e in listed)
    made = {(f, m.function, m.old, m.new) for f in {k[0] for k in keys} for m in mutants((ROOT / f).read_text())}
    assert [k for k in keys if k not in made] == []


def test_some_mutants_of_the_quick_modules_die() -> None:
    """A process of its own: it splits off one for each mutant, before anything of the project is imported."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.mutation.check", "--quick"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 1), done.stderr
    rows = [line.split() for line in done.stdout.splitlines() if line.endswith("%")]
    assert [r[0] for r in rows] == ["ledger", "gaussian", "gauge"]
    # which ones are drawn changes with every edit of a module: one new gap is for the whole check to find
    assert sum(int(r[2]) + int(r[3]) for r in rows) >= 8, done.stdout


def test_listed_files_and_tests_are_there() -> None:
    listed = tomllib.loads((HERE / "modules.toml").read_text())
    named = [f for m in listed.values() for f in (*m["files"], *m["tests"])]
    assert [f for f in named if not (ROOT / f).is_file()] == []
