"""The machine gives out: every command on a full disk, without memory, streams or cache, and ended by signals.

``python -m tests.faults.exhaustion [--verb VERB …] [--condition NAME …] [--points 3] [--dense]``

Most cases run in a copy of this process (a fork) that holds the loaded program; memory, cache and signals during the
imports need a process of their own. After each case:

* the exit code is 0, or that of the condition (1; 130 and 143 for signals; -9 for SIGKILL);
* nothing on stderr is a traceback, nothing waits longer than :data:`PATIENCE`;
* the output is the old one, the new one, or an unfinished one that readers refuse; no temporary file is left;
* the same command afterwards ends with 0 and the new output.

The command ends with a table, one line per condition, and exit code 1 if one case failed.
"""

from __future__ import annotations

import argparse
import errno
import mmap
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from graphslam.app import cli
from graphslam.app.run import outputs
from graphslam.app.sessions import merge_outputs
from graphslam.core.atomic import is_part
from graphslam_studies.montecarlo import folder as study_folder
from tests.faults.kills import (
    ROOT,
    STUDY,
    Operations,
    State,
    arguments_2d,
    called,
    finished_3d,
    log_2d,
    loop_of,
    snapshot,
)
from tests.pictures import save_point

PATIENCE = 600.0
"""Seconds after which a case hangs."""
MEMORY = (300, 500, 750, 1000, 2000)
"""Limits of the address space [MB]."""
STREAMS = ("stdout closed", "stderr closed", "stdout full", "stderr full", "stdout unread", "stderr unread")
SIGNALS = {"SIGINT": (signal.SIGINT, 130), "SIGTERM": (signal.SIGTERM, 143), "SIGKILL": (signal.SIGKILL, -9)}
TRACES = ("Traceback", "Exception ignored", "Fatal Python error")


@dataclass(frozen=True)
class Verb:
    """A command.

    Parameters
    ----------
    arguments : callable
        Given the folder that holds ``log``, ``a``, ``b`` (runs) and the outputs, whose names begin with ``out``.
    same : tuple of str
        Shell patterns of the output, whose bytes are compared; empty: it writes nothing that can be compared.
    odd : str
        ``file`` or ``folder``: its argument after ``--out`` or ``--figure``.
    """

    arguments: Callable[[Path], list[str]]
    same: tuple[str, ...] = ()
    odd: str = ""


def _path(verb: str, *options: str) -> Callable[[Path], list[str]]:
    """Arguments in which ``@name`` is a file of the folder."""
    return lambda work: [verb, *(str(work / o[1:]) if o.startswith("@") else o for o in options)]


DATUM = ("--datum", "35.68,139.76")
FLAT = {
    "simulate": Verb(
        _path("simulate", "landmark-field", "--preset", "quick", "--seed", "4", "--out", "@out"),
        ("out/*.npz", "out/log.json"),
        "folder",
    ),
    "run": Verb(lambda work: [*arguments_2d(work)], tuple(f"out/{p}" for p in outputs.SAME_BYTES), "folder"),
    "calibrate": Verb(_path("calibrate", "@log", "--quick", "--out", "@out.toml"), ("out.toml",), "file"),
    "join": Verb(_path("join", "@a", "--out", "@out"), ("out/joined.npz", "out/nodes.tum"), "folder"),
    "compare": Verb(
        _path("compare", "@a", "--methods", "batch", "--no-memory", "--figure", "@out.png"), ("out.png",), "file"
    ),
    "solve": Verb(_path("solve", "@a/graph.g2o", "--out", "@out.g2o.gz"), ("out.g2o.gz",), "file"),
    "report": Verb(_path("report", "@a", "--out", "@out.html"), ("out.html",), "file"),
    "export tum": Verb(_path("export", "@a", "--format", "tum", "--out", "@out.tum"), ("out.tum",), "file"),
    "export kitti": Verb(_path("export", "@a", "--format", "kitti", "--out", "@out.txt"), ("out.txt",), "file"),
    "export kml": Verb(_path("export", "@a", *DATUM, "--out", "@out.kml"), ("out.kml",), "file"),
    "export geojson": Verb(
        _path("export", "@a", "--format", "geojson", *DATUM, "--out", "@out.geojson"), ("out.geojson",), "file"
    ),
    "export mcap": Verb(_path("export", "@a", "--format", "mcap", "--out", "@out.mcap"), ("out.mcap",), "file"),
    "export ros2": Verb(
        _path("export", "@a", "--format", "ros2", "--out", "@out"), ("out/*.db3", "out/*.yaml"), "folder"
    ),
    "init": Verb(_path("init", "@log", "--force", "--out", "@out.toml"), ("out.toml",), "file"),
    "study": Verb(
        _path("study", STUDY, "--trials", "2", "--quick", "--json", "--out", "@out"), study_folder.SAME_BYTES, "folder"
    ),
    "merge": Verb(
        _path("merge", "@a", "@b", "--out", "@out"),
        tuple(f"out/{p}" for p in merge_outputs.SAME_BYTES if not p.endswith(".png")),
        "folder",
    ),
    "eval": Verb(_path("eval", "@a/trajectory.tum", "@b/trajectory.tum")),
    "loops": Verb(_path("loops", "@a")),
    "data check": Verb(lambda work: ["data", "check", str(work / "log")]),
    "data list": Verb(lambda work: ["data", "list"]),
    "options": Verb(lambda work: ["options"]),
    "doctor": Verb(lambda work: ["doctor"]),
}
DENSE = {
    "map": Verb(
        lambda work: ["map", str(work / "out"), "--low", "0.1", "--high", "0.9", "--grid"],
        tuple(f"out/{p}" for p in (*outputs.SAME_BYTES, "map.grid.npz")),
    ),
    "loops --undo": Verb(
        lambda work: ["loops", str(work / "out"), "--undo", loop_of(work)],
        tuple(f"out/{p}" for p in outputs.SAME_BYTES),
    ),
    "export nav2": Verb(_path("export", "@out", "--format", "nav2", "--out", "@out2"), ("out2/map*",), "folder"),
    "export autoware": Verb(
        _path("export", "@out", "--format", "autoware", *DATUM, "--heading", "90", "--out", "@out2"),
        ("out2/*.yaml", "out2/*/*.pcd"),
        "folder",
    ),
    "export mcap": Verb(_path("export", "@out", "--format", "mcap", "--out", "@out2.mcap"), ("out2.mcap",), "file"),
    "relax": Verb(_path("relax", "@out", "--out", "@out2.tum"), ("out2.tum",), "file"),
    "localise": Verb(lambda work: ["localise", str(work / "out"), str(work / "out"), "--submap", "0"]),
    "demo": Verb(
        _path("demo", "--preset", "quick", "--json", "--out", "@out2"),
        tuple(f"out2/{p}" for p in outputs.SAME_BYTES),
        "folder",
    ),
}


def flat(work: Path) -> None:
    """A log and two runs of it."""
    log_2d(work)
    for name, seed in (("a", 5), ("b", 6)):
        called(arguments_2d(work, name, seed))


# --- cases --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ended:
    """How a command ended: exit code (negative: the signal; None: it did not), what it printed, and when."""

    code: int | None
    out: str
    err: str
    seconds: float = 0.0


@dataclass
class Tally:
    """Cases of a condition, and what is wrong with some."""

    cases: int = 0
    faults: list[str] = field(default_factory=list)


class Counted(Operations):
    """The number of operations of a copy of this process."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.shared = mmap.mmap(-1, 8)

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        super().__call__(event, arguments)
        self.shared[:] = self.count.to_bytes(8, "little")

    def total(self) -> int:
        """Of the copy, after its end."""
        return int.from_bytes(self.shared[:], "little")


class Full(Operations):
    """From the k-th operation on that needs room on the disk, there is none.

    ``late``: the k-th file can be opened, but not written.
    """

    def __init__(self, folder: Path, at: int, late: bool) -> None:
        super().__init__(folder)
        self.at, self.late = at, late

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        before = self.count
        if event in ("open", "os.mkdir", "os.link", "os.symlink"):
            super().__call__(event, arguments)
        if self.count == before or self.count < self.at:
            return
        if self.late:
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        else:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(arguments[0]))


class Strike(Operations):
    """A signal before the k-th operation."""

    def __init__(self, folder: Path, at: int, number: int) -> None:
        super().__init__(folder)
        self.at, self.number = at, number

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        before = self.count
        super().__call__(event, arguments)
        if before < self.count == self.at:
            os.kill(os.getpid(), self.number)


def copied(arguments: list[str], prepare: Callable[[], Any] = lambda: None, *, lost: str = "") -> Ended:
    """The command line in a copy of this process."""
    begin, pipes = time.monotonic(), (os.pipe(), os.pipe())
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child == 0:
        code = 99
        try:
            os.setsid()
            for number, (read, write) in zip((1, 2), pipes):
                os.dup2(write, number)
                os.close(read)
                os.close(write)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            _lose(lost)
            sys.argv = ["graphslam", *arguments]
            prepare()
            try:
                cli.main()
                code = 0
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else int(end.code is not None)
            with suppress(AttributeError):
                sys.stdout.flush()
        except BaseException:
            with suppress(Exception):
                os.write(2, traceback.format_exc().encode())
        finally:
            os._exit(code)
    for number, (_, write) in zip(("stdout", "stderr"), pipes):
        os.close(write)
        if lost == f"{number} unread":
            os.close(pipes[number == "stderr"][0])
    return _heard(child, [r for (r, _), n in zip(pipes, ("stdout", "stderr")) if lost != f"{n} unread"], begin, lost)


def _lose(lost: str) -> None:
    """What the interpreter finds at its start if a stream is closed or full."""
    name, _, how = lost.partition(" ")
    if not name:
        return
    number = 1 if name == "stdout" else 2
    if how == "closed":
        os.close(number)
        setattr(sys, name, None)
        setattr(sys, f"__{name}__", None)
    elif how == "full":
        os.dup2(os.open("/dev/full", os.O_WRONLY), number)
    else:
        time.sleep(0.2)  # until the other end is closed


def _heard(child: int, streams: list[int], begin: float, lost: str) -> Ended:
    received = dict.fromkeys(streams, b"")
    waiting = set(streams)
    while waiting and time.monotonic() < begin + PATIENCE:
        for s in select.select(list(waiting), [], [], 1.0)[0]:
            part = os.read(s, 65536)
            received[s] += part
            if not part:
                waiting.discard(s)
    late = bool(waiting)
    if late:
        os.killpg(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    texts = [received[s].decode(errors="replace") for s in streams]
    for s in streams:
        os.close(s)
    if len(texts) == 1:
        texts = ["", *texts] if lost.startswith("stdout") else [*texts, ""]
    return Ended(None if late else code, *texts, time.monotonic() - begin)


def executed(arguments: list[str], *, memory: int = 0, after: tuple[int, float] | None = None, **more: str) -> Ended:
    """The command line in a process of its own, with a limit of memory [MB], or a signal after some seconds."""

    def limit() -> None:
        if memory:
            resource.setrlimit(resource.RLIMIT_AS, (memory * 10**6,) * 2)

    begin = time.monotonic()
    env = {**os.environ, "PYTHONPATH": str(ROOT), "MPLBACKEND": "Agg", **more}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [sys.executable, "-m", "graphslam", *arguments]
    process = subprocess.Popen(command, cwd=ROOT, env=env, text=True, preexec_fn=limit, **streams)  # type: ignore[call-overload]
    try:
        if after is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(after[1])
            process.send_signal(after[0])
        out, err = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return Ended(None, "", "", time.monotonic() - begin)
    return Ended(process.returncode, out, err, time.monotonic() - begin)


class Bench:
    """The verbs of one prepared folder."""

    def __init__(self, root: Path, verbs: dict[str, Verb], prepare: Callable[[Path], None], points: int) -> None:
        self.base, self.work, self.verbs, self.points = root / "base", root / "work", verbs, points
        self.table: dict[str, Tally] = {}
        Figure.savefig = save_point  # type: ignore[method-assign, assignment]
        self.base.mkdir(parents=True)
        prepare(self.base)

    def fresh(self) -> None:
        """Everything as it was before the verb."""
        shutil.rmtree(self.work, ignore_errors=True)
        shutil.copytree(self.base, self.work, symlinks=True)

    def state(self, verb: Verb) -> State:
        """The output."""
        return snapshot(self.work, verb.same)

    def check(self, condition: str, name: str, ended: Ended, codes: set[int], states: list[State] | None) -> bool:
        """Enter a case in the table; whether nothing is wrong with it."""
        tally, wrong = self.table.setdefault(condition.partition(",")[0], Tally()), ""
        tally.cases += 1
        if ended.code is None:
            wrong = f"hangs for {PATIENCE:g} s"
        elif any(t in ended.err for t in TRACES):
            wrong = f"traceback: {' | '.join(ended.err.splitlines()[-3:])}"
        elif ended.code not in codes:
            wrong = f"exit code {ended.code}: {ended.err[-200:]}"
        elif states is not None and (found := self.state(self.verbs[name])) not in states:
            mixed = sorted(n for n in {*found, *states[-1]} if found.get(n) != states[-1].get(n))
            wrong = f"mixed output: {', '.join(mixed[:4])}"
        elif ended.code != -9 and (left := [p.name for p in self.work.rglob("*.part*") if is_part(p.name)]):
            wrong = f"temporary file left: {left[0]}"
        if wrong:
            tally.faults.append(f"{name}, {condition}: {wrong}")
            print(f"FAULT {tally.faults[-1]}", flush=True)
        return not wrong

    def measure(self, name: str, conditions: set[str]) -> None:
        """All cases of a verb."""
        verb, arguments = self.verbs[name], self.verbs[name].arguments
        self.fresh()
        begin = time.monotonic()
        called(arguments(self.work))  # loads modules and kernels
        self.fresh()
        old, asked = self.state(verb), arguments(self.work)
        counted = Counted(self.work)
        ended = copied(asked, lambda: sys.addaudithook(counted))
        if not self.check("nothing", name, ended, {0}, None):
            return
        operations, new = counted.total(), self.state(verb)
        states = [old, new] if verb.same else None
        for condition, cases in _CONDITIONS.items():
            if condition in conditions:
                case = ""
                for case, made, codes, allowed in cases(self, verb, asked, operations, states):
                    self.fresh()
                    self.check(f"{condition}, {case}", name, made(), codes, allowed)
                again = condition in AGAIN and verb.same and name not in ("merge", "loops --undo")
                if case and again:
                    self.check(f"{condition}, again after {case}", name, copied(asked), {0}, [new])
        print(f"{name}: {operations} operations, {time.monotonic() - begin:.0f} s", flush=True)


AGAIN = ("disk full", "SIGINT", "SIGTERM", "SIGKILL")
Cases = Iterator[tuple[str, Callable[[], Ended], set[int], list[State] | None]]


def _spread(count: int, points: int) -> list[int]:
    """Operations, the first and the last among them."""
    return sorted({1 + round(k * (count - 1) / max(points - 1, 1)) for k in range(points)}) if count else []


def comparable(verb: Verb, states: Any) -> Any:
    """States that are whole; a run grows, so that only the end of the next one is compared."""
    return None if states is None or any("submaps" in p for p in verb.same) else states


def _full(b: Bench, verb: Verb, asked: list[str], operations: int, states: Any) -> Cases:
    for late in (False, True):
        for k in _spread(operations, b.points):

            def hook(k: int = k, late: bool = late) -> Ended:
                return copied(asked, lambda: sys.addaudithook(Full(b.work, k, late)))

            yield f"{'write' if late else 'operation'} {k}", hook, {0, 1}, comparable(verb, states)


def _signals(name: str) -> Callable[[Bench, Verb, list[str], int, Any], Cases]:
    number, code = SIGNALS[name]

    def cases(b: Bench, verb: Verb, asked: list[str], operations: int, states: Any) -> Cases:
        for k in _spread(operations, b.points):

            def hook(k: int = k) -> Ended:
                return copied(asked, lambda: sys.addaudithook(Strike(b.work, k, number)))

            yield f"operation {k}", hook, {0, code}, comparable(verb, states)
        for seconds in [] if name == "SIGKILL" or b.points < 3 else [0.1, 0.3, 1.0, 3.0]:
            yield f"after {seconds} s", lambda s=seconds: executed(asked, after=(number, s)), {0, code, -number}, None

    return cases


def _streams(b: Bench, verb: Verb, asked: list[str], operations: int, states: Any) -> Cases:
    for lost in STREAMS:
        codes = {0} if "stderr" in lost or "closed" in lost else {1}
        whole = None if states is None else [states[-1]]
        yield lost, lambda lost=lost: copied(asked, lost=lost), codes, whole


def _memory(b: Bench, verb: Verb, asked: list[str], operations: int, states: Any) -> Cases:
    if verb.same in (("out.png",), ("out.html",)):  # a process of its own draws real pictures
        states = None
    for limit in MEMORY:
        yield f"{limit} MB", lambda m=limit: executed(asked, memory=m), {0, 1}, comparable(verb, states)


def _no_cache(b: Bench, verb: Verb, asked: list[str], operations: int, states: Any) -> Cases:
    (b.base.parent / "file").write_text("")
    env = {"XDG_CACHE_HOME": str(b.base.parent / "file"), "NUMBA_CACHE_DIR": "", "MPLCONFIGDIR": str(b.base.parent)}
    yield "a file in its place", lambda: executed(asked, **env), {0}, None


def _odd(b: Bench, verb: Verb, asked: list[str], operations: int, states: Any) -> Cases:
    if not verb.odd:
        return
    at = 1 + max(k for k, a in enumerate(asked) if a in ("--out", "--figure"))
    for odd in ("", ".", "/", "..", "file/x", "fifo", "file" if verb.odd == "folder" else "folder", "taken"):

        def made(odd: str = odd) -> Ended:
            os.mkfifo(b.work / "fifo")
            (b.work / "file").write_text("mine")
            (b.work / "folder").mkdir()
            (b.work / "taken").mkdir() if verb.odd == "folder" else os.mkfifo(b.work / "taken")
            if verb.odd == "folder":
                (b.work / "taken" / "mine.txt").write_text("mine")
            target = odd if odd in ("", ".", "/", "..") else str(b.work / odd)
            before = snapshot(b.work, ("*", "*/*"))
            ended = copied([*asked[:at], target, *asked[at + 1 :]])
            if snapshot(b.work, ("*", "*/*")) != before:
                return Ended(ended.code, ended.out, "Traceback: something was written", ended.seconds)
            return ended

        yield repr(odd), made, {1, 2}, None


def _fifos(b: Bench, verb: Verb, asked: list[str], operations: int, states: Any) -> Cases:
    b.fresh()
    used = [Path(a) for a in asked if a.startswith(str(b.work)) and Path(a).exists()]
    files = [f for u in used for f in (sorted(p for p in u.rglob("*") if p.is_file()) if u.is_dir() else [u])]
    for file in [files[k - 1] for k in _spread(len(files), 2 * b.points)]:

        def made(file: Path = file) -> Ended:
            file.unlink()
            os.mkfifo(file)
            return copied(asked)

        yield file.relative_to(b.work).as_posix(), made, {0, 1}, None


def _two(b: Bench, verb: Verb, asked: list[str], operations: int, states: Any) -> Cases:
    def made() -> Ended:
        first = os.fork()
        if first == 0:
            ended = copied(asked)
            os._exit(0 if ended.code in (0, 1) and not any(t in ended.err for t in TRACES) else 3)
        second = copied(asked)
        code = os.waitstatus_to_exitcode(os.waitpid(first, 0)[1])
        return second if code == 0 else Ended(second.code, second.out, f"Traceback: the other one\n{second.err}")

    if verb.same:
        yield "at once", made, {0, 1}, [states[-1]]


_CONDITIONS: dict[str, Callable[[Bench, Verb, list[str], int, Any], Cases]] = {
    "disk full": _full,
    **{name: _signals(name) for name in SIGNALS},
    "streams": _streams,
    "odd --out": _odd,
    "fifo": _fifos,
    "two processes": _two,
    "memory": _memory,
    "no cache": _no_cache,
}


def main() -> int:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--verb", action="append", default=[])
    parser.add_argument("--condition", action="append", default=[])
    parser.add_argument("--points", type=int, default=3, help="writes at which each condition strikes")
    parser.add_argument("--dense", action="store_true", help="the commands of dense maps instead")
    given = parser.parse_args()
    verbs, prepare = (DENSE, finished_3d) if given.dense else (FLAT, flat)
    with tempfile.TemporaryDirectory(prefix="exhaustion-") as folder:
        bench = Bench(Path(folder), verbs, prepare, given.points)
        for name in given.verb or verbs:
            bench.measure(name, set(given.condition or _CONDITIONS))
    faults = 0
    for condition, tally in bench.table.items():
        print(f"{condition}: {tally.cases} cases, {len(tally.faults)} faults")
        faults += len(tally.faults)
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main())
