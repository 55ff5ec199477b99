"""The whole matrix of the front ends on grids, run once: ``python -m tests.faults.grid_table [seed …]``."""

from __future__ import annotations

import sys
import time

from tests.faults.grid_rows import FRONT_ENDS, ROWS
from tests.faults.grid_trial import Seen, trial
from tests.faults.grid_worlds import world


def in_words(seen: Seen) -> str:
    """One row of the table after its name."""
    if seen.refused:
        return f"refused: {seen.refused[:110]}"
    codes = ", ".join(sorted(f"{f.level}:{f.code}" for f in seen.lines if f.level in ("bad", "look")))
    score = f"error {seen.error:.2f} m, NEES/dof of exits {seen.exits:.2f}, of nodes {seen.nodes:.2f} ({seen.dof:.0f})"
    return f"{score}{' !' if seen.confident else ''}; {codes}"


def _report(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(seeds: list[int], dims: tuple[int, ...] = (2, 3)) -> int:
    """Print a line a run; the number of rows that are silently wrong is the exit code."""
    wrong = 0
    for seed in seeds:
        for dim in dims:
            drive = world(dim, seed)
            for frontend in FRONT_ENDS:
                begin = time.process_time()
                clean = trial(None, drive, frontend)
                _report(f"{dim}-D {frontend} clean: {in_words(clean)} [{time.process_time() - begin:.1f} s]")
                for row in ROWS:
                    if dim not in row.dims:
                        continue
                    begin = time.process_time()
                    seen = trial(row, drive, frontend)
                    silent = seen.silently_wrong(clean)
                    wrong += silent
                    mark = "SILENT " if silent else ""
                    took = f"[{time.process_time() - begin:.1f} s]"
                    _report(f"{dim}-D {frontend} {row.name} ({row.outcome}): {mark}{in_words(seen)} {took}")
    _report(f"silently wrong: {wrong}")
    return wrong


if __name__ == "__main__":
    sys.exit(min(main([int(s) for s in sys.argv[1:]] or [3]), 1))
