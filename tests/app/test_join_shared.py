"""``graphslam join`` by several workers: a local Dask cluster of two, and a pool of two processes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graphslam.app.cli import app
from graphslam.core.errors import ConfigError
from graphslam.core.submap import Submap
from graphslam.io.submap_store import write_submaps
from graphslam.join.registry import join_by_method
from graphslam_studies.sim.local_maps import simulate_local_maps


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Submap]]:
    submaps, truth = simulate_local_maps(40, 5, scans=15)
    folder = tmp_path_factory.mktemp("shared")
    write_submaps(folder, submaps, truth=truth)
    return folder, submaps


def joined(folder: Path, out: Path, *options: str) -> tuple[dict, np.ndarray]:
    done = CliRunner().invoke(app, ["join", str(folder), "--json", "--polish", "--out", str(out), *options])
    assert done.exit_code == 0, done.output
    (row,) = json.loads(done.stdout)["methods"]
    return row, np.load(out / "joined.npz")["poses"]


def test_cluster_and_workers_join_the_same_map(store: tuple[Path, list[Submap]], tmp_path: Path) -> None:
    folder, _ = store
    alone, poses = joined(folder, tmp_path / "alone")
    with pytest.importorskip("distributed").LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        shared = [joined(folder, tmp_path / "cluster", "--cluster", cluster.scheduler_address)]
    shared.append(joined(folder, tmp_path / "workers", "--workers", "2"))
    for row, found in shared:
        np.testing.assert_array_equal(found, poses)
        assert {k: v for k, v in row.items() if k != "seconds"} == {k: v for k, v in alone.items() if k != "seconds"}
    assert alone["nees_dof"] == alone["states"]


def test_what_cannot_be_shared_is_refused(store: tuple[Path, list[Submap]]) -> None:
    _, submaps = store
    with pytest.raises(ConfigError, match="only eif-tree"):
        join_by_method(submaps, "ekf", workers=2)
    with pytest.raises(ConfigError, match="either a number of workers or the address"):
        join_by_method(submaps, workers=2, cluster="tcp://here:1")
