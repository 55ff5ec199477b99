"""This project beside what a user would pick instead: ``python -m tests.benchmarks.bench_peers [ROW …]``.

``ROW`` is the name of a row (``isam2``), of a peer (``kiss-slam``) or both (``isam2/GTSAM``), default all;
``--cases NAME …`` some of its cases, ``--repeat 3`` runs, ``--list`` prints the rows. ``make bench-peers ROWS="…"``
does the same.

A peer is installed from the package registry into an environment of its own below ``build/peers``; one that cannot be
installed is printed as such, with the reason. Each run is a process of its own on one core and with one thread, but
for ``two-cores``, whose ``elapsed`` [s] is by the clock: it needs two free cores. After a run that is not counted
(kernels are compiled then), the two take turns. A line of the table is a figure: minimum, median and maximum of ours,
of the peer and of the ratios of the turns, the ratio of the means, the goal, and whether the means meet it. ``work``
is CPU time without imports [s], ``cold`` that of a first call, ``whole`` that of the process, ``peak`` its memory
[MB]. ``error`` is the ATE [m] (lidar, isam2), a distance [m] (register), an objective (join; solve beside g2o) or
objective / best known - 1 (solve beside GTSAM). Figures of isam2 are of single updates [ms CPU]: ``update`` the mean,
``with factors`` with ``add_submap``, while GTSAM's factors are made outside the time.

``--quick`` installs nothing: small cases of peers that are in this environment.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.benchmarks.peers import inputs
from tests.benchmarks.peers.rows import ROWS, Goal, Row

ROOT = Path(__file__).resolve().parents[2]
PLACE = ROOT / "build" / "peers"
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS", "TBB_NUM_THREADS")


class PeerError(Exception):
    """A peer that cannot be installed, or a run that failed."""


def environment(row: Row, quick: bool) -> Path:
    """Python of the environment of a peer, which is made if needed."""
    if not row.packages:
        return Path(sys.executable)
    if quick:
        raise PeerError("not installed: --quick installs nothing")
    folder = PLACE / "environments" / row.environment
    python, stamp = folder / "bin" / "python", folder / "installed.txt"
    wanted = " ".join(row.packages)
    if not stamp.exists() or stamp.read_text().splitlines()[0] != wanted:
        print(f"installing {wanted} into {folder.relative_to(ROOT)}", file=sys.stderr, flush=True)
        pip = [str(python), "-m", "pip", "--disable-pip-version-check", "--quiet"]
        commands = ([sys.executable, "-m", "venv", str(folder)], [*pip, "install", "--no-compile", *row.packages])
        for command in commands:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise PeerError("cannot be installed: " + (done.stderr.strip().splitlines() or ["no message"])[-1])
        versions = subprocess.run([*pip, "freeze"], capture_output=True, text=True, check=True).stdout
        stamp.write_text(f"{wanted}\n{versions}")
    return python


def one_run(
    command: list[str], folder: Path, out: Path, seconds: float, *, every_core: bool = False
) -> tuple[dict[str, Any], dict[str, Path]]:
    """Figures and arrays of a process, on one core or on all."""
    for old in out.parent.glob(out.stem + ".*"):
        old.unlink()
    cores = os.sched_getaffinity(0) if every_core else {idle_core()}
    settings = dict.fromkeys(THREADS, "1") | {"PYTHONPATH": os.pathsep.join(map(str, ours_path())), "MPLBACKEND": "Agg"}
    command = [*command, str(folder), str(out)]
    try:
        done = subprocess.run(
            command, cwd=ROOT, env=os.environ | settings, capture_output=True, text=True, timeout=seconds, check=False,
            preexec_fn=lambda: os.sched_setaffinity(0, cores),
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise PeerError(f"no end in {seconds:.0f} s") from None
    if done.returncode or not out.exists():
        raise PeerError(f"failed ({done.returncode}): " + (done.stderr.strip().splitlines() or ["no message"])[-1])
    return json.loads(out.read_text()), {p.name.split(".")[-2]: p for p in out.parent.glob(out.stem + ".*.npy")}


def idle_core() -> int:
    """The core that works least at the moment."""

    def idle() -> dict[int, int]:
        rows = (line.split() for line in Path("/proc/stat").read_text().splitlines() if line.startswith("cpu"))
        return {int(r[0][3:]): int(r[4]) for r in rows if r[0] != "cpu"}

    before = idle()
    time.sleep(0.2)
    after = idle()
    return max(os.sched_getaffinity(0), key=lambda core: after.get(core, 0) - before.get(core, 0))


def ours_path() -> tuple[Path, ...]:
    """Where the import packages of this clone are."""
    return ROOT, ROOT / "frontends", ROOT / "notebooks" / "studies"


def measured(row: Row, case: str, options: argparse.Namespace) -> tuple[dict[str, Any], dict[str, Any]]:
    """Figures by name ``(repeat,)`` of ours and of the peer."""
    theirs = environment(row, options.quick)
    folder = PLACE / "inputs" / row.make.__name__ / case
    if not (folder / "made").exists():
        folder.mkdir(parents=True, exist_ok=True)
        row.make(folder, case)
        (folder / "made").touch()
    own = [sys.executable, "-m", "tests.benchmarks.peers.ours"]
    peer = [str(theirs), str(ROOT / "tests/benchmarks/peers/theirs.py")] if row.packages else own
    sides = ((own, row.ours), (peer, row.theirs))
    wide = row.name == "two-cores"
    if not options.quick and row.name != "first-run":
        one_run([*own, row.ours], folder, folder / "warm.json", options.timeout, every_core=wide)
    found: tuple[dict[str, list[float]], ...] = ({}, {})
    for _ in range(options.repeat):
        for side, (command, work) in enumerate(sides):
            who = ("ours", row.peer)[side]
            try:
                figures, arrays = one_run(
                    [*command, work], folder, folder / f"{side}.json", options.timeout, every_core=wide and not side
                )
            except PeerError as error:
                raise PeerError(f"{who} {error}") from None
            score = row.score(folder, arrays) if row.score else None
            if score is not None:
                figures["error"] = score
            for key, value in figures.items():
                found[side].setdefault(key, []).append(value)
    return found


def spread(values: Any) -> str:
    """Minimum, median, maximum."""
    few = (np.min(values), np.median(values), np.max(values))
    return f"{few[0]:.4g}" if few[0] == few[2] else " / ".join(f"{v:.3g}" for v in few)


def lines(row: Row, case: str, found: tuple[dict[str, Any], dict[str, Any]]) -> list[tuple[str, bool | None]]:
    """Lines of the table, and whether each meets its goal (None: it has none)."""
    goals = {g.figure: g for g in row.goals}
    out: list[tuple[str, bool | None]] = []
    for figure in (*goals, *row.shown):
        if figure not in found[0] or figure not in found[1]:
            continue
        a, b = np.array(found[0][figure]), np.array(found[1][figure])
        mean = a.mean() / b.mean() if b.mean() else np.nan
        goal: Goal | None = goals.get(figure)
        met, text = None, ""
        if goal is not None:
            value = {"ratio": mean, "value": a.mean(), "excess": a.mean() - b.mean()}[goal.kind]
            met = bool(value <= goal.limit)
            text = ("yes" if met else "**no**") + ("" if goal.kind == "ratio" else f" ({value:.3g})")
        with np.errstate(all="ignore"):
            cells = (
                f"{row.name} {case}", row.peer, figure, spread(a), spread(b), spread(a / b), f"{mean:.2f}",
                str(goal or ""), text,
            )  # fmt: skip
        out.append(("| " + " | ".join(cells) + " |", met))
    return out


def main() -> int:
    """See the module's docstring."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("rows", nargs="*")
    p.add_argument("--cases", nargs="+", default=[])
    p.add_argument("--repeat", type=int, default=3)
    p.add_argument("--timeout", type=float, default=900.0, help="of one process [s]")
    p.add_argument("--list", action="store_true")
    p.add_argument("--quick", action="store_true")
    a = p.parse_args()
    if a.quick:
        a.repeat = 1
    head = ("work and case", "peer", "figure", "ours", "peer's", "ratios", "of means", "goal", "met")
    print("| " + " | ".join(head) + " |\n|" + "---|" * len(head), flush=True)
    met: list[bool] = []
    for row in ROWS:
        if a.rows and not {row.name, row.peer.split()[0], f"{row.name}/{row.peer.split()[0]}"} & set(a.rows):
            continue
        for case in row.quick if a.quick else row.cases:
            if a.cases and case not in a.cases:
                continue
            if a.list:
                goals = ", ".join(f"{g.figure} {g}" for g in row.goals)
                print(f"| {row.name} {case} | {row.peer} | {goals} |")
                continue
            try:
                for line, good in lines(row, case, measured(row, case, a)):
                    print(line, flush=True)
                    met += [] if good is None else [good]
            except (PeerError, inputs.MissingDataError) as why:
                print(f"| {row.name} {case} | {row.peer} | {why} |" + " |" * 6, flush=True)
    print(f"\n{sum(met)} of {len(met)} goals met")
    return 0


if __name__ == "__main__":
    sys.exit(main())
