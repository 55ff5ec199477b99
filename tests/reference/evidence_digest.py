"""A day in the life of a pool of evidence grids, as one hash a subject: for comparing ways of running the same code.

``python -m tests.reference.evidence_digest [threads]`` prints them as JSON.
"""

from __future__ import annotations

import hashlib
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from graphslam.evidence import contents, queries
from graphslam.evidence.batch import update_grids
from graphslam.evidence.compact import compact_grids
from graphslam.evidence.formats import load_npz, to_dense
from graphslam.evidence.grid import EvidenceGrid
from graphslam.evidence.memory import measure_memory
from graphslam.evidence.octomap import read_octomap, write_octomap
from graphslam.evidence.pool import GridPool


def _hash(*things: Any) -> str:
    h = hashlib.sha256()
    for thing in things:
        if isinstance(thing, bytes):
            h.update(thing)
        else:
            a = np.ascontiguousarray(thing)
            h.update(f"{a.dtype.str} {a.shape}".encode())
            h.update((a + 0).tobytes())  # -0 is 0
    return h.hexdigest()


def _grids(grids: list[EvidenceGrid]) -> str:
    return _hash(*(x for g in grids for x in (g.brick_coordinates(), g.brick_values())))


def _poses(rng: np.random.Generator, n: int, spread: float) -> np.ndarray:
    q = np.array([0.1, -0.2, 0.3, 0.9]) + 0.01 * rng.normal(size=(n, 4))
    return np.hstack([rng.normal(size=(n, 3)) * spread, q / np.linalg.norm(q, axis=1)[:, None]])


def digest(threads: int = 1, dim: int = 3) -> dict[str, str]:
    """Hashes of what some grids hold and say after updates, resampling, merging, files and compaction."""
    rng = np.random.default_rng(11)
    pool = GridPool(levels=3)
    first = EvidenceGrid(0.2, pool=pool, dim=dim)
    grids = [first.copy() for _ in range(5)]
    out: dict[str, str] = {}

    def poses(spread: float) -> np.ndarray:
        T = _poses(rng, len(grids), spread)
        return T if dim == 3 else T[:, [0, 1, 5]]

    reports = []
    for step in range(4):
        points = rng.normal(size=(12, dim)) * 2.5
        points[0] = np.nan
        reports.append(
            update_grids(
                grids, poses(0.05), points, origin=rng.normal(size=dim) * 0.1, max_range=4.0,
                returns=rng.random(12) < 0.8, threads=threads,
            )
        )  # fmt: skip
        grids = [grids[k].copy() for k in (0, 0, 2, 3, 3)] if step == 1 else grids
    out["reports"] = _hash(repr(reports).encode())
    out["updates"] = _grids(grids)
    directions, T = rng.normal(size=(10, dim)), poses(0.3)
    for name, blind in (("casts", True), ("casts to the unknown", False)):
        c = queries.cast_grids(grids, T, None, directions, 9.0, ignore_unknown=blind, voxels=True, threads=threads)
        out[name] = _hash(c.ranges, c.status, c.voxels)
    points = rng.normal(size=(30, dim)) * 2
    for how in ("nearest", "trilinear"):
        out[how] = _hash(queries.endpoint_probability(grids, T, points, interpolation=how, threads=threads))
    grids[0].merge(grids[2], T[0])
    out["merged"] = _grids(grids)
    g = grids[0]
    binned = contents.binned_cloud(g, 2)
    boxes = contents.box_query(g, points - 1.0, points + 1.0)
    out["contents"] = _hash(
        g.occupied_cloud(), binned.points, binned.counts, boxes.occupied, boxes.known, boxes.voxels,
        contents.bounding_box(g), contents.entropy(g), contents.value_counts(g),
    )  # fmt: skip
    out["dense"] = _hash(to_dense(g).values)
    out["compacted"] = _hash(repr(compact_grids(grids)).encode(), _grids(grids).encode())
    out["memory"] = _hash(repr(measure_memory(grids[:2])).encode())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        g.save(path)
        out["npz"] = _hash(path.read_bytes(), _grids([load_npz(path)]).encode())
        for suffix in (".bt", ".ot") if dim == 3 else ():
            path = Path(folder) / f"a{suffix}"
            write_octomap(g, path)
            out[suffix] = _hash(path.read_bytes(), _grids([read_octomap(path)]).encode())
    return out


if __name__ == "__main__":
    threads = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    sys.stdout.write(json.dumps({f"{dim}-D {k}": v for dim in (3, 2) for k, v in digest(threads, dim).items()}))
