"""Fuzz every reader: ``python -m tests.faults.fuzz --cases 10000 [--reader NAME] [--seed N] [--case K]``.

A damaged input must be refused with an error of our own, or be read with every number finite. Anything else counts
against the reader: another exception, the end of the process by a signal, text on stderr, more than 20 s, or more than
1 GB beyond what the process held before. Case k of a reader is the same for the same seed, whichever process runs it.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import gc
import json
import logging
import math
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import traceback
import warnings
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pandas as pd
import scipy.sparse as sp

from graphslam.core.errors import GraphSlamError
from tests.faults.mutate import damage
from tests.faults.readers import READERS, Reader

SECONDS = 20
MEMORY = 1 << 30
KINDS = ("refused", "accepted", "traceback", "hang", "blow-up", "signal", "not-finite", "printed")
BAD = frozenset(KINDS[2:])


class Hang(BaseException):
    """It took too long."""


def not_finite(value: Any, open_fields: frozenset[str], where: str = "", depth: int = 0) -> str | None:
    """Where a value holds a number that is not finite, or None."""
    if "*" in open_fields or depth > 12:
        return None
    if isinstance(value, float):
        return None if math.isfinite(value) else where
    if isinstance(value, np.ndarray):
        return None if value.dtype.kind not in "fc" or np.isfinite(value).all() else where
    if sp.issparse(value):
        return not_finite(value.data, open_fields, f"{where}.data", depth + 1)
    if isinstance(value, pd.DataFrame):
        items: Any = [(str(c), value[c].to_numpy()) for c in value]
    elif isinstance(value, Mapping):
        items = [(str(k), v) for k, v in value.items()]
    elif isinstance(value, (list, tuple)):
        items = [("", v) for v in value]
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        items = [(f.name, getattr(value, f.name)) for f in dataclasses.fields(value)]
    else:
        return None
    for name, inner in items:
        if name in open_fields:
            continue
        found = not_finite(inner, open_fields, f"{where}.{name}" if name else where, depth + 1)
        if found is not None:
            return found
    return None


@contextlib.contextmanager
def guarded() -> Iterator[None]:
    """At most 20 s and 1 GB more."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise Hang

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    held = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(SECONDS)
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, hard))
    try:
        yield
    finally:
        signal.alarm(0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def stderr_in(stream: Any) -> Iterator[None]:
    """What compiled code prints on stderr goes to a file."""
    kept = os.dup(2)
    os.dup2(stream.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


class Bench:
    """One reader at work: a valid input is made once, and damaged anew for every case."""

    def __init__(self, name: str, folder: Path, seed: int) -> None:
        self.name, self.reader, self.seed = name, READERS[name], seed
        self.good, self.bad = folder / "good", folder / "bad"
        self.good.mkdir(parents=True)
        self.reader.make(self.good)
        reader: Reader = self.reader
        found = not_finite(reader.read(self.good), reader.open_fields)  # it must be read, and warms what is compiled
        assert found is None, f"{name}: the valid input is not finite at {found}"

    def case(self, k: int) -> tuple[str, str, str]:
        """Kind of the outcome, what was done, and what came of it."""
        with tempfile.TemporaryFile() as stream:
            with stderr_in(stream):
                kind, done, found = self._case(k)
            stream.seek(0)
            text = stream.read().decode(errors="replace")
        return ("printed", done, text) if text and kind not in BAD else (kind, done, found)

    def _case(self, k: int) -> tuple[str, str, str]:
        shutil.rmtree(self.bad, ignore_errors=True)
        shutil.copytree(self.good, self.bad, symlinks=True)
        rng = np.random.default_rng([self.seed, zlib.crc32(self.name.encode()), k])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            done = damage(rng, self.bad)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                with guarded(), np.errstate(all="ignore"):
                    value = self.reader.read(self.bad)
                    found = not_finite(value, self.reader.open_fields)
            except GraphSlamError as error:
                return "refused", done, " ".join(str(error).split())
            except Hang:
                return "hang", done, f"more than {SECONDS} s"
            except MemoryError as error:
                gc.collect()
                return "blow-up", done, str(error)
            except Exception:
                return "traceback", done, traceback.format_exc(limit=-4, chain=False)
        return ("accepted", done, "") if found is None else ("not-finite", done, found)


def compile_once() -> None:
    """Make ``rosbags`` compile equal code once, not once per bag: that is four fifths of the time of a case."""
    from rosbags.serde import cdr, ros1, utils

    compiled = functools.cache(lambda text: utils.compile_lines([text]))
    for module in (cdr, ros1):
        module.compile_lines = lambda lines: compiled("\n".join(lines))


def child(name: str, first: int, last: int, seed: int, folder: Path) -> None:
    """Run cases and print one line of JSON each."""
    logging.disable(logging.CRITICAL)
    compile_once()
    bench = Bench(name, folder, seed)
    print(json.dumps(["ready"]), flush=True)
    for k in range(first, last):
        print(json.dumps([k, *bench.case(k)]), flush=True)


def run_reader(name: str, cases: int, seed: int) -> tuple[Counter[str], list[tuple[int, str, str, str]]]:
    """All cases of a reader, in a process that is begun again where it dies; outcomes by kind, and the bad ones."""
    counts: Counter[str] = Counter()
    bad: list[tuple[int, str, str, str]] = []
    cases = max(cases // READERS[name].slow, 10)
    k = 0
    while k < cases:
        with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
            arguments = ["--child", name, "--seed", str(seed), "--first", str(k), "--cases", str(cases)]
            command = [sys.executable, "-m", "tests.faults.fuzz", *arguments, "--folder", f"{folder}/{name}"]
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, bufsize=1) as process:
                assert process.stdout is not None
                ready = False
                while True:
                    waiting, _, _ = select.select([process.stdout], [], [], 900 if not ready else SECONDS + 20)
                    line = process.stdout.readline() if waiting else ""
                    if not line:
                        break
                    message = json.loads(line)
                    ready = True
                    if message == ["ready"]:
                        continue
                    k = message[0] + 1
                    counts[message[1]] += 1
                    if message[1] in BAD:
                        bad.append((message[0], message[1], message[2], message[3]))
                if k < cases:
                    hung = process.poll() is None and not waiting
                    process.kill()
                    process.wait()
                    if not ready:
                        raise SystemExit(f"{name}: the valid input cannot be read")
                    kind = "hang" if hung else "signal"
                    counts[kind] += 1
                    bad.append((k, kind, "", f"the process ended with {process.returncode}"))
                    k += 1
    return counts, bad


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description="Damage the input of every reader, and see what comes of it.")
    parser.add_argument("--cases", type=int, default=1000, help="of each reader")
    parser.add_argument("--reader", action="append", choices=sorted(READERS), help="may be repeated; default all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", type=int, help="only this one, with all that it says")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--first", type=int, default=0, help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    a = parser.parse_args()
    if a.child:
        child(a.child, a.first, a.cases, a.seed, a.folder)
        return
    names = a.reader or list(READERS)
    if a.case is not None:
        for name in names:
            with tempfile.TemporaryDirectory() as folder:
                print(name, *Bench(name, Path(folder) / name, a.seed).case(a.case), sep="\n")
        return
    print(f"{'reader':16}{'cases':>8}" + "".join(f"{k:>12}" for k in KINDS), flush=True)
    failed = False
    for name in names:
        counts, bad = run_reader(name, a.cases, a.seed)
        print(f"{name:16}{sum(counts.values()):>8}" + "".join(f"{counts[k]:>12}" for k in KINDS), flush=True)
        seen: Counter[str] = Counter()
        for k, kind, done, text in bad:
            last = text.strip().split("\n")[-1]
            seen[kind + last[:60]] += 1
            if seen[kind + last[:60]] <= 2:
                indented = text.strip().replace("\n", "\n        ")
                print(f"    case {k}: {kind}: {done}\n        {indented}", flush=True)
        failed |= bool(bad)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    os.environ.setdefault("MPLBACKEND", "Agg")
    main()
