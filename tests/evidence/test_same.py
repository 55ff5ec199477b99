"""The same bits however the code is run: compiled or not, by one thread or more, once or again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from graphslam.evidence.batch import BATCH, update_grids
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.pool import GridPool
from tests.reference.evidence_digest import digest
from tests.reference.evidence_pool import assert_same, check_pool
from tests.reference.evidence_twin import EvidenceTwin

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def compiled() -> dict[int, dict[str, str]]:
    return {dim: digest(1, dim) for dim in (3, 2)}


def test_subjects_differ_from_each_other(compiled: dict[int, dict[str, str]]) -> None:
    """Or equality of hashes would say nothing."""
    hashes = [h for d in compiled.values() for h in d.values()]
    assert len(set(hashes)) == len(hashes) > 20


def test_python_and_compiled_code_give_the_same_bits(compiled: dict[int, dict[str, str]]) -> None:
    """Kernels run as plain Python in a process of their own, where a numpy scalar that overflows is an error too."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", "-m", "tests.reference.evidence_digest"],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert json.loads(done.stdout) == {f"{dim}-D {k}": v for dim, d in compiled.items() for k, v in d.items()}


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
def test_any_number_of_threads_gives_the_same_bits(threads: int, compiled: dict[int, dict[str, str]]) -> None:
    for dim, wanted in compiled.items():
        assert digest(threads, dim) == wanted


def test_more_grids_than_a_batch_and_more_bricks_than_the_scratch_has(rng: np.random.Generator) -> None:
    """Many copies of one map, far-reaching scans, resampling: threads agree, and a sample of grids with twins."""
    n = BATCH + 9
    poses = np.zeros((3, n, 7))
    poses[..., :3], poses[..., 6] = rng.normal(size=(3, n, 3)) * 0.1, 1.0
    scans = rng.normal(size=(3, 12, 3)) * 25
    keep = rng.integers(0, n, n)
    worlds = {}
    for threads in (1, 2, 3):
        pool = GridPool(levels=4)
        first = EvidenceGrid(0.2, pool=pool)
        grids = [first.copy() for _ in range(n)]
        for k in range(3):
            report = update_grids(grids, poses[k], scans[k], threads=threads)
            assert report.bricks > 1024 * 2  # more than scratch memory starts with
            if k == 1:
                grids = [grids[i].copy() for i in keep]
        worlds[threads] = grids, report, pool.used_nodes, pool.used_bricks
        if threads == 2:
            check_pool(pool, [*grids, first])
    grids, *wanted = worlds[1]
    for threads in (2, 3):
        others, *got = worlds[threads]
        assert got == wanted
        for a, b in zip(grids, others):
            np.testing.assert_array_equal(a.brick_coordinates(), b.brick_coordinates())
            np.testing.assert_array_equal(a.brick_values(), b.brick_values())
    twin = EvidenceTwin(0.2, grids[5].model, grids[5].pool.half)
    for k, which in ((0, keep[5]), (1, keep[5]), (2, 5)):
        twin.insert_scan(scans[k], pose=poses[k, which])
    assert_same(grids[5], twin)
