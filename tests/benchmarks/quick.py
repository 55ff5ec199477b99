"""All benchmarks in quick mode: ``python -m tests.benchmarks.quick [PROCESSES]``.

A process runs one after the other, so that the package is imported and its kernels are loaded once per process. The
output of a benchmark is printed as a whole, after its name and its CPU time. Exit code 1 if one of them fails.
"""

from __future__ import annotations

import os
import runpy
import sys
import tempfile
import traceback
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path


def run(name: str) -> tuple[str, float, bool, str]:
    """Name, CPU time with child processes [s], success and output of a benchmark."""
    begin = sum(os.times()[:4])
    sys.argv = [name, "--quick"]
    good = True
    with tempfile.TemporaryFile() as out:
        for stream in (1, 2):
            os.dup2(out.fileno(), stream)
        try:
            runpy.run_module(f"tests.benchmarks.{name}", run_name="__main__", alter_sys=True)
        except SystemExit as ended:
            good = not ended.code
        except BaseException:
            traceback.print_exc()
            good = False
        sys.stdout.flush()
        sys.stderr.flush()
        out.seek(0)
        text = out.read().decode(errors="replace")
    return name, sum(os.times()[:4]) - begin, good, text


def main(processes: int) -> int:
    """Run all of them; returns the exit code."""
    names = sorted(p.stem for p in Path(__file__).parent.glob("bench_*.py"))
    failed = []
    with ProcessPoolExecutor(processes) as pool:
        for done in as_completed([pool.submit(run, name) for name in names]):
            name, seconds, good, text = done.result()
            print(f"== {name} ({seconds:.0f} s)\n{text}", flush=True)
            if not good:
                failed.append(name)
    print("failed: " + ", ".join(failed) if failed else f"{len(names)} benchmarks")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 2))
