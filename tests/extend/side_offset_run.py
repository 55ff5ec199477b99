"""A run with the sensor of :mod:`tests.extend.side_offset`; prints what is found of it as JSON."""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import graphslam as gs
from graphslam.core.errors import GraphSlamError
from graphslam.core.geometry import se2_compose, se2_exp
from graphslam.core.poses import SE2
from graphslam.graph.sensors import sensor_kinds
from graphslam.io.log_store import save_log
from tests.extend.side_offset import SideOffset, SideOffsetBatch, SideOffsetFactors, SideOffsetRecord

PLAIN = {"calibrate": {"use": "none"}}


def main() -> None:
    """Run."""
    assert sensor_kinds()["side-offset"] is SideOffsetFactors
    log = gs.simulate("landmark-field", preset="quick", seed=1)
    assert log.truth is not None
    path, rng = log.truth.trajectory, np.random.default_rng(5)
    times = np.linspace(path.times[0] + 1.0, path.times[-1] - 1.0, 40)
    offsets = SE2.between(path.poses[:1], path.interpolate(times))[:, 1] + rng.normal(0.0, 0.02, 40)
    readings = SideOffset(times=times, offsets=offsets, sigma=np.full(40, 0.02))
    plain = gs.run(log, frontend="ekf", config=PLAIN, progress=False)
    log = replace(log, streams={**log.streams, "side-offset": readings})
    with tempfile.TemporaryDirectory() as folder:
        save_log(log, Path(folder) / "log")
        read = gs.load(Path(folder) / "log")["side-offset"]
    run = gs.run(log, frontend="ekf", config=PLAIN, progress=False)
    batch = gs.run(log, frontend="ekf", solver="batch", config=PLAIN, progress=False)
    assert run.graph is not None
    record = next(r for r in run.graph.records.values() if isinstance(r, SideOffsetRecord))
    factor, x = SideOffsetBatch([record], run.graph.values.layout()), run.graph.values.poses[record.node]
    _, J = factor.terms(x[None])
    steps = [1e-6 * e for e in np.eye(3)]
    slope = [
        (factor.terms(se2_compose(x, se2_exp(d))[None])[0] - factor.terms(se2_compose(x, se2_exp(-d))[None])[0]) / 2e-6
        for d in steps
    ]
    try:
        run.graph.add_sensor(read, stream="side-offset")
        twice = ""
    except GraphSlamError as error:
        twice = str(error)
    (use,) = [s for s in run.report["streams"] if s["name"] == "side-offset"]
    (row,) = [c for c in run.report["graph"]["classes"] if c["class"] == "side-offset"]
    found = {
        "jacobian": float(np.abs(J.ravel() - np.ravel(slope)).max()),
        "solvers_apart": float(np.abs(batch.map.node_poses - run.map.node_poses).max()),
        "used": use["used"],
        "offered": use["offered"],
        "read": len(read.times),
        "chi2_per_dof": row["chi2_per_dof"],
        "side_error": [
            float(np.abs(m.node_poses - SE2.between(path.poses[:1], path.interpolate(m.node_times)))[:, 1].mean())
            for m in (run.map, plain.map)
        ],
        "twice": twice,
    }
    sys.stdout.write(json.dumps(found))
