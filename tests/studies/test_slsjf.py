"""Published local maps as submaps."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from graphslam.core.errors import CovarianceError, FormatError, MissingDataError
from graphslam.core.geometry import se2_compose, se2_transform, tangent_to_vector_covariance
from graphslam_studies.io.slsjf import read_slsjf_local_map, read_slsjf_local_maps


@pytest.mark.data
def test_the_200_maps(data_dir: Path) -> None:
    maps = read_slsjf_local_maps(data_dir / "victoria_park_processed")
    assert [m.key for m in maps] == list(range(200))
    assert [m.report["source"] for m in maps[:3]] == ["localmap_1.mat", "localmap_2.mat", "localmap_3.mat"]
    assert maps[41].interval == (41.0, 42.0)
    assert sum(len(m.landmarks) for m in maps) == 3889
    assert len(set(np.concatenate([m.landmarks.ids for m in maps]).tolist())) == 299
    # as published, to the last bit but rounding asymmetry
    raw = scipy.io.loadmat(data_dir / "victoria_park_processed/slsjf_200_local_maps/localmap_42.mat")
    np.testing.assert_array_equal(maps[41].landmarks.mean, raw["localmap_st"][:, 1])
    np.testing.assert_allclose(maps[41].landmarks.covariance, raw["localmap_P"], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(
        tangent_to_vector_covariance(maps[41].exit_pose, maps[41].exit_covariance),
        raw["localmap_P"][:3, :3],
        atol=1e-12,
    )


@pytest.mark.data
def test_chained_maps_agree_on_common_trees(data_dir: Path) -> None:
    maps = read_slsjf_local_maps(data_dir / "victoria_park_processed/slsjf_200_local_maps")
    pose = np.zeros(3)
    before: dict[int, np.ndarray] = {}
    gaps = []
    for m in maps:
        here = dict(zip(m.landmarks.ids.tolist(), se2_transform(pose, m.landmarks.positions)))
        gaps += [np.linalg.norm(here[k] - before[k]) for k in here.keys() & before.keys()]
        before, pose = here, se2_compose(pose, m.exit_pose)
    assert len(gaps) > 1500
    assert 0.05 < np.median(gaps) < 0.2


def write_map(path: Path, *, n: int = 2, seed: int = 0, **change: np.ndarray) -> None:
    rng = np.random.default_rng(seed)
    size = 3 + 2 * n
    root = rng.normal(size=(size, size))
    state = np.column_stack([np.concatenate([[0, 0, 0], np.repeat(np.arange(n) + 5, 2)]), rng.normal(size=size)])
    scipy.io.savemat(path, {"localmap_st": state, "localmap_P": root @ root.T + np.eye(size), **change})


def test_order_is_numeric_and_holes_are_refused(tmp_path: Path) -> None:
    for k in range(1, 12):
        write_map(tmp_path / f"localmap_{k}.mat", seed=k)
    write_map(tmp_path / "localmap_x.mat")
    maps = read_slsjf_local_maps(tmp_path)
    assert [m.report["source"] for m in maps] == [f"localmap_{k}.mat" for k in range(1, 12)]
    (tmp_path / "localmap_7.mat").unlink()
    with pytest.raises(MissingDataError, match=r"wanted localmap_7\.mat"):
        read_slsjf_local_maps(tmp_path)
    shutil.rmtree(tmp_path)
    with pytest.raises(MissingDataError, match="no local map"):
        read_slsjf_local_maps(tmp_path)


def test_bad_maps_name_the_file(tmp_path: Path) -> None:
    path = tmp_path / "localmap_1.mat"
    write_map(path)
    good = read_slsjf_local_map(path, 0).landmarks
    P, mean = good.covariance, good.mean
    ids = np.array([0, 0, 0, 5, 5, 6, 6.0])
    asymmetric = P.copy()
    asymmetric[0, 1] += 0.1
    rounding = P.copy()
    rounding[0, 1] += 1e-12
    write_map(path, localmap_P=rounding)
    again = read_slsjf_local_map(path, 0).landmarks.covariance
    np.testing.assert_array_equal(again, again.T)
    for change, kind, message in (
        ({"localmap_P": asymmetric}, CovarianceError, "localmap_1.mat: covariance is not symmetric"),
        ({"localmap_P": -P}, CovarianceError, "localmap_1.mat: covariance is not positive definite"),
        ({"localmap_P": np.zeros((7, 7))}, CovarianceError, "positive definite"),
        ({"localmap_P": P[:5, :5]}, CovarianceError, "wrong shape"),
        ({"localmap_P": np.full((7, 7), np.nan)}, CovarianceError, "not finite"),
        ({"localmap_st": np.column_stack([ids, mean])[:6]}, FormatError, "wrong shape"),
        ({"localmap_st": np.column_stack([ids + 1, mean])}, FormatError, "feature ids"),
        ({"localmap_st": np.column_stack([ids[::-1], mean])}, FormatError, "feature ids"),
        ({"localmap_st": np.column_stack([ids * 1.1, mean])}, FormatError, "feature ids"),
        ({"localmap_st": np.column_stack([ids * 1e20, mean])}, FormatError, "feature ids"),
        ({"localmap_st": np.column_stack([ids, mean * np.nan])}, FormatError, "row 0 of the state is not finite"),
    ):
        write_map(path, **change)
        with pytest.raises(kind, match=message):
            read_slsjf_local_map(path, 0)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(FormatError, match=r"localmap_1\.mat"):
        read_slsjf_local_maps(tmp_path)
