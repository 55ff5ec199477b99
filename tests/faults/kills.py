"""SIGKILL at many moments of every verb that writes a folder, and what is there each time.

``python -m tests.faults.kills [--kills 50] [--verb VERB …] [--seed N] [--exec SHARE]``

A fifth of the kills (``--exec``) strike at random moments of a process of its own (``python -m graphslam …``),
between the end of its imports and its last moment. The others strike just before the k-th operation by which the
verb changes the file system, with k drawn from all of them: so the writing phase is covered too. After each:

* through the plain paths, every file of the named list is that of the old state, or every one is that of the new;
* the public readers read the folder, or say that the run is not finished;
* the same verb again ends with the bytes of a run that was never killed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.app.folders.generations import new_generation
from graphslam.app.report.report import make_report
from graphslam.app.run import outputs
from graphslam.app.run.files import loops_of_run
from graphslam.app.sessions import merge_outputs
from graphslam.app.worlds import simulate, write_simulated
from graphslam.core.errors import RunFolderError
from graphslam.io.submap_store import SubmapStore, read_submaps
from graphslam.sim.crawler import simulate_crawler
from graphslam.sim.crawler_config import CrawlerConfig
from graphslam.sim.ring_hall import ring_hall
from graphslam_studies.montecarlo import folder as study_folder
from graphslam_studies.montecarlo.folder import StudyFolder
from tests.pictures import save_point

ROOT = Path(__file__).resolve().parents[2]
STUDY = "tests.reference.small_study:STUDY"
SETTINGS_3D = ("frontend.filter.particles=1", "backend.loops=true")
CHANGES = frozenset({"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.symlink", "os.truncate"})
State = dict[str, bytes]


@dataclass(frozen=True)
class Verb:
    """A verb and the folder that it writes.

    Parameters
    ----------
    prepare : callable
        Fills a folder with what the verb needs: inputs, and in ``out`` the old state.
    arguments : callable
        Of the command line, given that folder.
    same : tuple of str
        Shell patterns of the files that are compared.
    back : callable, optional
        Arguments that take the new state back to the old one.
    """

    prepare: Callable[[Path], None]
    arguments: Callable[[Path], list[str]]
    same: tuple[str, ...]
    back: Callable[[Path], list[str]] | None = None


@dataclass
class Tally:
    """What became of the kills of one verb."""

    old: int = 0
    new: int = 0
    late: int = 0
    faults: list[str] = field(default_factory=list)


def snapshot(folder: Path, patterns: Iterable[str]) -> State:
    """Bytes of the named files through their plain paths."""
    found = {p for pattern in patterns for p in folder.glob(pattern) if p.is_file()}
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(found)}


# --- what is killed ---------------------------------------------------------------------------------------------


def log_2d(work: Path) -> None:
    """A landmark field with GPS."""
    write_simulated(simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3), work / "log")


def log_3d(work: Path) -> None:
    """Twice round a corner, with a re-entry."""
    write_simulated(simulate_crawler(ring_hall(seed=9), 9, CrawlerConfig(drift=0.08, max_range=8.0)), work / "log")


def arguments_2d(work: Path, out: str = "out", seed: int = 5) -> list[str]:
    """A quick run of landmarks."""
    options = ["--set", "frontend.particles=20", "--set", "gps.use=every-second", "--seed", str(seed)]
    return ["run", str(work / "log"), "--out", str(work / out), *options, "--resume", "--json"]


def arguments_3d(work: Path) -> list[str]:
    """A quick run of SegSLAM, with its loops and its fused map."""
    options = [x for s in SETTINGS_3D for x in ("--set", s)]
    return ["run", str(work / "log"), "--frontend", "segslam", "--out", str(work / "out"), "--seed", "2", *options,
            "--resume", "--json"]  # fmt: skip


def finished_3d(work: Path) -> None:
    """A finished run of SegSLAM."""
    log_3d(work)
    called(arguments_3d(work))
    shutil.rmtree(work / "log")  # nothing after it may ask for the log


def two_runs(work: Path) -> None:
    """Two runs of one field."""
    log_2d(work)
    for name, seed in (("a", 5), ("b", 6)):
        called(arguments_2d(work, name, seed))


def old_report(work: Path) -> None:
    """A finished run with another page than its own."""
    log_2d(work)
    called(arguments_2d(work))
    with new_generation(work / "out") as new:
        new.write_text("report.html", "the page as it was")
        new.adopt()


def loop_of(work: Path) -> str:
    """Number of a loop that is in, or was taken out."""
    return str(next(d.loop for d in loops_of_run(work / "out").current() if d.verdict in ("accepted", "undone")))


VERBS = {
    "run-2d": Verb(log_2d, arguments_2d, outputs.SAME_BYTES),
    "run-3d": Verb(log_3d, arguments_3d, outputs.SAME_BYTES),
    "study": Verb(
        lambda work: None,
        lambda work: ["study", STUDY, "--trials", "2", "--quick", "--out", str(work / "out"), "--json"],
        study_folder.SAME_BYTES,
    ),
    "merge": Verb(
        two_runs,
        lambda work: ["merge", str(work / "a"), str(work / "b"), "--out", str(work / "out"), "--json"],
        merge_outputs.SAME_BYTES,
    ),
    "map": Verb(
        finished_3d,
        lambda work: ["map", str(work / "out"), "--low", "0.1", "--high", "0.9", "--grid", "--json"],
        (*outputs.SAME_BYTES, "map.grid.npz", "report.html"),
    ),
    "undo": Verb(
        finished_3d,
        lambda work: ["loops", str(work / "out"), "--undo", loop_of(work), "--json"],
        outputs.SAME_BYTES,
        lambda work: ["loops", str(work / "out"), "--redo", loop_of(work), "--json"],
    ),
    "report": Verb(
        old_report,
        lambda work: ["report", str(work / "out"), "--json"],
        (*outputs.SAME_BYTES, "report.html"),
    ),
}


# --- processes --------------------------------------------------------------------------------------------------


def called(arguments: list[str]) -> None:
    """A verb, in this process."""
    result = CliRunner().invoke(app, arguments)
    if result.exit_code != 0:
        raise RuntimeError(f"{' '.join(arguments)}: {result.output} {result.exception!r}")


class Operations:
    """Counts the operations by which this process changes what is below a folder, and may end with one of them."""

    def __init__(self, folder: Path, kill_before: int | None = None) -> None:
        self.count, self.folder, self.kill_before = 0, f"{folder}{os.sep}", kill_before

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        """An audit hook, called before the operation."""
        if event == "open":
            flags = arguments[2]
            if not flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
                return
        elif event not in CHANGES:
            return
        names = [os.fsdecode(a) for a in arguments[:2] if isinstance(a, (str, bytes, os.PathLike))]
        inside = any(n == self.folder[:-1] or n.startswith(self.folder) for n in names)
        if not inside and (event == "open" or not any(not os.path.isabs(n) for n in names)):
            return  # relative names: of a tree that is being removed
        self.count += 1
        if self.count == self.kill_before:
            os.kill(os.getpid(), signal.SIGKILL)


def forked(arguments: list[str], out: Path, kill_before: int | None = None) -> tuple[int, int]:
    """A verb in a copy of this process; how it ended (negative: the signal), and its number of operations."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.close(read)
            silent = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silent, 1)
            os.dup2(silent, 2)
            hook = Operations(out, kill_before)
            sys.addaudithook(hook)
            called(arguments)
            os.write(write, str(hook.count).encode())
            code = 0
        except BaseException:
            os.write(write, traceback.format_exc().encode()[-4000:])
        finally:
            os._exit(code)
    os.close(write)
    with os.fdopen(read) as stream:
        text = stream.read()
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if code > 0:
        raise RuntimeError(f"{' '.join(arguments)}: {text}")
    return code, int(text) if code == 0 else 0


def executed(arguments: list[str], kill_after: float | None = None) -> tuple[int, float]:
    """A verb as a user calls it; how it ended, and after how many seconds."""
    begin = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "graphslam", *arguments],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        process.wait(kill_after)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    return process.returncode, time.monotonic() - begin


# --- what is there ----------------------------------------------------------------------------------------------


class Bench:
    """One verb, its two states, and the kills.

    Parameters
    ----------
    name : str
    work : Path
        Empty folder.
    """

    def __init__(self, name: str, work: Path) -> None:
        self.name, self.verb = name, VERBS[name]
        names = sorted(n for n, v in VERBS.items() if v.prepare is self.verb.prepare)
        self.base, self.work = work / "-".join(names), work / "work"
        Figure.savefig = save_point  # type: ignore[method-assign, assignment]
        if not self.base.is_dir():  # another verb begins with the same
            self.prepare()
        self.fresh()
        called(self.arguments())  # imports and kernels are loaded once, not in every copy of this process
        if threading.active_count() > 1:
            raise RuntimeError(f"{name}: threads that a copy would not have")
        self.fresh()
        self.old = self.state()
        _, self.operations = forked(self.arguments(), self.out)
        self.new = self.state()
        if self.old == self.new or not self.new:
            raise RuntimeError(f"{name}: its two states are the same")
        self.news = [self.new]
        """The new state; and as processes of their own write it, which draw real pictures."""
        self.new_submaps = self.submap_files()

    def prepare(self) -> None:
        """What the verb begins with, made by a copy of this process: no later copy should find its threads here."""
        self.base.mkdir(parents=True)
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                self.verb.prepare(self.base)
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        if os.waitpid(pid, 0)[1] != 0:
            raise RuntimeError(f"{self.name}: cannot be prepared")

    @property
    def out(self) -> Path:
        """The folder that is written."""
        return self.work / "out"

    def arguments(self) -> list[str]:
        """Of the verb."""
        return self.verb.arguments(self.work)

    def fresh(self) -> None:
        """Everything as it was before the verb."""
        shutil.rmtree(self.work, ignore_errors=True)
        shutil.copytree(self.base, self.work, symlinks=True)

    def state(self) -> State:
        """Named files as they are."""
        return snapshot(self.out, self.verb.same)

    def submap_files(self) -> State:
        """Files of the store."""
        return snapshot(self.out, ("submaps/*.npz",))

    def look(self) -> tuple[str, str]:
        """``old`` or ``new``, and what is wrong with it, if anything is."""
        found = self.state()
        if self.name.startswith("run") or self.name == "study":  # they begin with nothing, and grow
            growing = {n for n in found if n.startswith("submaps/") or n in ("config.toml", "study.json")}
            if set(found) == growing:
                return "old", self.look_unfinished()
        if found in self.news:
            return "new", self.look_finished()
        if found == self.old:
            return "old", self.look_finished() if self.old else ""
        mixed = sorted(n for n in {*found, *self.new} if found.get(n) != self.new.get(n))
        return "?", f"neither old nor new: {', '.join(mixed[:6])}"

    def look_unfinished(self) -> str:
        """An interrupted run or study is a readable beginning of the whole one."""
        if self.name == "study":
            if (self.out / "study.json").is_file():
                StudyFolder(self.out).collect()
            return ""
        try:
            outputs.read_run_folder(self.out)
            return "an unfinished run is opened as a finished one"
        except RunFolderError:
            pass
        if (self.out / "submaps" / "index.json").is_file():
            read_submaps(self.out)
            named = [f"submaps/{e['file']}" for e in SubmapStore(self.out).entries]
            have = self.submap_files()
            if any(have[n] != self.new_submaps[n] for n in named):
                return "a finished submap has other bytes"
        if (self.out / "config.toml").is_file() and make_report(self.out).kind != "interrupted":
            return "the report takes it for finished"
        return ""

    def look_finished(self) -> str:
        """The public readers read all of it."""
        if self.name == "study":
            table = StudyFolder(self.out).collect().table
            return "" if len(table) else "the study is empty"
        page = make_report(self.out)
        lost = {k: v for k, v in page.problems.items() if k != "clearest.json"}
        if self.name != "merge":
            outputs.read_run_folder(self.out)
            loops_of_run(self.out)
        return f"the report misses {lost}" if lost else ""

    def kill(self, strike: Callable[[], int], what: str, tally: Tally) -> None:
        """One kill, a look, and the verb again."""
        self.fresh()
        code = strike()
        if code == 0:
            tally.late += 1
        elif code != -signal.SIGKILL:
            tally.faults.append(f"{what}: ended with {code}")
            return
        try:
            which, wrong = self.look()
            if not wrong and not (which == "new" and self.name in ("undo", "merge")):
                forked(self.arguments(), self.out)  # an undone loop cannot be undone again, a merge is there
            if not wrong and self.state() not in self.news:
                wrong = "the verb again ends with other bytes"
            if not wrong and self.verb.back is not None:
                forked(self.verb.back(self.work), self.out)
                wrong = "" if self.state() == self.old else "taken back it has other bytes"
        except Exception as error:
            which, wrong = "?", f"{type(error).__name__}: {error}"
        if wrong:
            tally.faults.append(f"{what}: {wrong}")
        else:
            tally.old += which == "old"
            tally.new += which == "new"

    def after(self, seconds: float) -> int:
        """The verb in a process of its own, killed after so long."""
        return executed(self.arguments(), seconds)[0]

    def before(self, operation: int) -> int:
        """The verb in a copy of this process, killed before that operation."""
        return forked(self.arguments(), self.out, operation)[0]

    def kills(self, count: int, seed: int, share: float = 0.2) -> Tally:
        """Kill so many times, ``share`` of them at random moments of a process of its own."""
        rng, tally = np.random.default_rng(seed), Tally()
        timed = round(share * count)
        if timed:
            _, imported = executed(["--version"])
            self.fresh()
            code, whole = executed(self.arguments())
            real = self.state()
            drawn = (".png", ".html")
            if code != 0 or any(real.get(n) != v for n, v in self.new.items() if not n.endswith(drawn)):
                tally.faults.append("a process of its own ends with other bytes")
            self.news.append(real)
            imported = min(imported, 0.9 * whole)
            for t in np.sort(rng.uniform(imported, whole, timed)).tolist():
                self.kill(partial(self.after, t), f"after {t:.2f} s of {whole:.2f}", tally)
        edges = np.linspace(1, self.operations + 1, count - timed + 1)
        for a, b in pairwise(edges):
            k = int(rng.integers(int(a), max(int(b), int(a) + 1)))
            moment = f"before operation {k} of {self.operations}"
            self.kill(partial(self.before, k), moment, tally)
        return tally


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("--kills", type=int, default=50, help="of each verb")
    parser.add_argument("--verb", action="append", choices=sorted(VERBS), help="may be repeated; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--exec", type=float, default=0.2, dest="share", help="share of kills of processes of their own"
    )
    options = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):  # on one core no work is done on threads, which a copy would not have
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    bad = 0
    with tempfile.TemporaryDirectory() as folder:
        for name in options.verb or VERBS:
            begin = time.monotonic()
            bench = Bench(name, Path(folder).resolve())
            tally = bench.kills(options.kills, options.seed, options.share)
            whole = tally.old + tally.new
            say(
                f"{name}: {options.kills} kills, {whole} whole ({tally.old} old, {tally.new} new; {tally.late} were "
                f"too late); {len(bench.new)} files the same after the verb again; {bench.operations} operations; "
                f"{time.monotonic() - begin:.0f} s"
            )
            for fault in tally.faults:
                say(f"  FAULT {fault}")
            bad += len(tally.faults)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
