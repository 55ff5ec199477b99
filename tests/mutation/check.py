"""Does a test fail when the program is wrong?  ``python -m tests.mutation.check [--module NAME] [--seed N]``

Small changes (:mod:`tests.mutation.operators`) are made to a module, one at a time, in a temporary file that is
imported in its place; the working tree is never touched. The module's own tests run until one fails: the change is
*killed*. A change that no test notices has *survived*: a test is missing, or code does nothing. Changes that do not
change the behaviour are listed with the reason in ``equivalent.toml``.

Libraries for this (mutmut, cosmic-ray) copy or edit the tree, do not draw by a seed, and leave out what matters here:
halved and doubled figures, dropped transposes, defaults of dataclasses.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

from tests.mutation.child import UNUSED, run
from tests.mutation.operators import Mutant, mutants

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).parent
WANTED = 0.9
"""Share of the mutants without equivalents that must be killed."""
HEAVY = (
    "pytest",
    "_hypothesis_pytestplugin",
    "numpy",
    "scipy.stats",
    "scipy.sparse.linalg",
    "scipy.optimize",
    "pandas",
    "numba",
    "gtsam",
)
"""Libraries that are imported once, before a process is split off for each mutant."""

Fork = multiprocessing.get_context("fork")


@dataclass
class Tally:
    """What became of the mutants of a module."""

    killed: int = 0
    equivalent: int = 0
    survived: list[str] = field(default_factory=list)

    @property
    def share(self) -> float:
        """Killed, of those that are not equivalent."""
        judged = self.killed + len(self.survived)
        return self.killed / judged if judged else 1.0


def draw(found: list[tuple[str, Mutant]], count: int, seed: int) -> list[tuple[str, Mutant]]:
    """One mutant of every function as far as ``count`` goes, and the rest from all that are left."""
    rng = random.Random(seed)
    shuffled = rng.sample(found, len(found))
    first: dict[tuple[str, str], tuple[str, Mutant]] = {}
    for file, m in shuffled:
        first.setdefault((file, m.function), (file, m))
    chosen = list(first.values())[:count]
    drawn = {id(m) for _, m in chosen}
    chosen += [(f, m) for f, m in shuffled if id(m) not in drawn][: count - len(chosen)]
    return sorted(chosen, key=lambda c: (c[0], c[1].line, c[1].new))


def outcome(file: str, source: str, tests: list[str], limit: float) -> tuple[int | None, float, str]:
    """Exit code of the tests (None: out of time), seconds, and the last lines they printed."""
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        changed, output = Path(folder) / Path(file).name, Path(folder) / "output.txt"
        changed.write_text(source)
        module = file.removesuffix(".py").replace("/", ".")
        begin = time.monotonic()
        process = Fork.Process(target=run, args=(module, changed, tests, output))
        process.start()
        process.join(limit)
        code = process.exitcode
        if code is None:
            os.killpg(process.pid or 0, signal.SIGKILL)
            process.join()
        return (
            code,
            time.monotonic() - begin,
            "".join(output.read_text(errors="replace").splitlines(keepends=True)[-25:]),
        )


def check(name: str, module: dict[str, list[str]], count: int | None, seed: int, kept: list[dict[str, str]]) -> Tally:
    """Run the mutants of one module.

    Raises
    ------
    SystemExit
        The tests fail without any change, or never import the module.
    """
    found = [(file, m) for file in module["files"] for m in mutants((ROOT / file).read_text())]
    chosen = found if count is None else draw(found, count, seed)
    known = {(e["file"], e["function"], e["old"], e["new"]) for e in kept}
    tally, tests = Tally(), {}
    limits: dict[str, float] = {}
    for file in dict.fromkeys(file for file, _ in chosen):
        tests[file] = [str(ROOT / t) for t in module["tests"]]
        code, seconds, output = outcome(file, (ROOT / file).read_text(), tests[file], 900.0)
        if code != 0:
            why = "never import it" if code == UNUSED else "fail without any change"
            raise SystemExit(f"{name}: the tests of {file} {why}\n{output}")
        limits[file] = 60.0 + 4.0 * seconds
    print(f"{name}: {len(chosen)} of {len(found)} mutants, seed {seed}", flush=True)
    for file, m in chosen:
        what = f"{file}:{m.line} {m.function}: {m.old}  →  {m.new}"
        if (file, m.function, m.old, m.new) in known:
            tally.equivalent += 1
            continue
        code, _, _ = outcome(file, m.source, tests[file], limits[file])
        if code in (0, UNUSED):
            tally.survived.append(what)
            print(f"  survived  {what}", flush=True)
        else:
            tally.killed += 1
        if code not in (0, 1, 2, UNUSED):  # neither passed nor failed, which counts as noticed
            print(f"  {'time-out' if code is None else f'exit {code}':8}  {what}", flush=True)
    return tally


def table(tallies: dict[str, Tally]) -> str:
    """One row a module."""
    lines = [f"{'module':12} {'mutants':>8} {'killed':>7} {'equivalent':>11} {'survived':>9} {'share':>7}"]
    for name, t in tallies.items():
        n = t.killed + t.equivalent + len(t.survived)
        lines.append(f"{name:12} {n:8} {t.killed:7} {t.equivalent:11} {len(t.survived):9} {t.share:7.1%}")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    modules = tomllib.loads((HERE / "modules.toml").read_text())
    equivalent = tomllib.loads((HERE / "equivalent.toml").read_text()).get("equivalent", [])
    parser = argparse.ArgumentParser(prog="python -m tests.mutation.check", description="Does a test notice?")
    parser.add_argument("--module", action="append", choices=list(modules), help="default: all; may be repeated")
    parser.add_argument("--mutants", type=int, default=36, help="of each module; 0: all there are (default 36)")
    parser.add_argument("--seed", type=int, default=0, help="which are drawn")
    parser.add_argument("--quick", action="store_true", help="three mutants of each module whose tests take a second")
    given = parser.parse_args(arguments)
    names = given.module or [n for n, m in modules.items() if m.get("quick") or not given.quick]
    count = 3 if given.quick else given.mutants or None
    for library in HEAVY:
        __import__(library)
    tallies = {n: check(n, modules[n], count, given.seed, equivalent) for n in names}
    print(table(tallies))
    return 0 if all(t.share >= WANTED for t in tallies.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
