"""The multifrontal factorisation against dense linear algebra, in any order, with and without amalgamation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from graphslam.core.errors import IndeterminateError
from graphslam.join.submap_pattern import BlockPattern, csc_of_blocks
from graphslam.linear import block_cholesky
from graphslam.linear.block_cholesky import BlockSymbolic


@dataclass
class Blocks:
    """A positive-definite matrix of node blocks: every pair stored both ways."""

    dense: np.ndarray
    width: np.ndarray
    at: np.ndarray
    ptr: np.ndarray
    neighbours: np.ndarray
    block: np.ndarray
    values: np.ndarray


def blocks(rng: np.random.Generator, nodes: int, density: float, *, band: int = 0) -> Blocks:
    width = rng.integers(1, 4, nodes)
    at = np.cumsum(width) - width
    adjacent = rng.random((nodes, nodes)) < density
    adjacent |= np.abs(np.subtract.outer(np.arange(nodes), np.arange(nodes))) <= band
    adjacent |= adjacent.T
    np.fill_diagonal(adjacent, True)
    A = rng.standard_normal((width.sum(),) * 2)
    A = np.where(np.repeat(np.repeat(adjacent, width, 0), width, 1), A + A.T, 0.0)
    A += np.diag(np.abs(A).sum(axis=1) + 0.1)
    parts = [(i, j) for i in range(nodes) for j in np.flatnonzero(adjacent[i])]
    values = [A[at[i] : at[i] + width[i], at[j] : at[j] + width[j]].ravel() for i, j in parts]
    sizes = np.array([len(v) for v in values])
    return Blocks(
        A,
        width,
        at,
        np.concatenate([[0], np.cumsum(adjacent.sum(axis=1))]),
        np.array([j for _, j in parts]),
        np.cumsum(sizes) - sizes,
        np.concatenate(values),
    )


def l_entries(A: np.ndarray, order: np.ndarray) -> int:
    """Entries of the Cholesky factor by the elimination game on scalars."""
    F = (A[np.ix_(order, order)] != 0).astype(bool)
    for k in range(len(F)):
        below = k + 1 + np.flatnonzero(F[k + 1 :, k])
        F[np.ix_(below, below)] = True
    return int(np.tril(F).sum())


CASES = [
    (1, 0.0, 0),
    (2, 0.0, 0),
    (30, 0.0, 0),
    (40, 0.06, 0),
    (60, 0.01, 2),
    (50, 1.0, 0),
    (90, 0.02, 1),
    (150, 1.0, 0),  # fronts of several blocks of columns
    (200, 0.05, 1),
]


@pytest.mark.parametrize("slack", [0, 48, 10_000])
@pytest.mark.parametrize(("nodes", "density", "band"), CASES)
def test_solutions_and_inverse_blocks(
    nodes: int, density: float, band: int, slack: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block_cholesky, "_SLACK", slack)
    A = blocks(rng, nodes, density, band=band)
    order = rng.permutation(nodes)
    symbolic = BlockSymbolic(order, A.width, A.ptr, A.neighbours)
    scalars = np.concatenate([A.at[i] + np.arange(A.width[i]) for i in order])
    assert symbolic.nnz == l_entries(A.dense, scalars)  # whatever the slack, and the postorder added nothing
    factor = symbolic.factor(A.block, A.values)
    inverse = np.linalg.inv(A.dense)
    b = rng.standard_normal(len(A.dense))
    np.testing.assert_allclose(factor.solve(b), inverse @ b, rtol=0, atol=1e-12)
    some = rng.permutation(len(b))[: min(len(b), 9)]
    np.testing.assert_allclose(factor.inverse_block(some), inverse[np.ix_(some, some)], rtol=0, atol=1e-12)
    J = rng.standard_normal((len(some), 4))
    expected = J.T @ inverse[np.ix_(some, some)] @ J
    np.testing.assert_allclose(factor.inverse_block(some, J), expected, rtol=0, atol=1e-12)
    for w in (1, 2, 3):
        at = rng.permutation(A.at[A.width == w])
        expected = np.array([inverse[i : i + w, i : i + w] for i in at]).reshape(-1, w, w)
        np.testing.assert_allclose(factor.inverse_diagonal_blocks(at, w), expected, rtol=0, atol=1e-12)


def test_damping_scales_the_diagonal(rng: np.random.Generator) -> None:
    A = blocks(rng, 30, 0.1)
    b = rng.standard_normal(len(A.dense))
    x = BlockSymbolic(np.arange(30), A.width, A.ptr, A.neighbours).factor(A.block, A.values, 0.7).solve(b)
    np.testing.assert_allclose(x, np.linalg.solve(A.dense + 0.7 * np.diag(np.diag(A.dense)), b), atol=1e-12)


def test_an_indefinite_matrix_is_refused_and_the_scalar_named(rng: np.random.Generator) -> None:
    A = blocks(rng, 20, 0.0)  # nodes apart from each other
    node = int(np.flatnonzero(A.width == 2)[0])
    A.values[A.block[A.ptr[node]]] = -1.0
    symbolic = BlockSymbolic(rng.permutation(20), A.width, A.ptr, A.neighbours)
    with pytest.raises(IndeterminateError, match=f"at scalar {A.at[node]}$"):
        symbolic.factor(A.block, A.values)
    A.values[:] = np.nan
    with pytest.raises(IndeterminateError):
        symbolic.factor(A.block, A.values)


def test_pattern_stores_every_pair_once(rng: np.random.Generator) -> None:
    A = blocks(rng, 35, 0.1)
    pattern = BlockPattern(A.width, A.ptr, A.neighbours)
    assert pattern.nnz == len(A.values)
    assert pattern.entries == (len(A.values) + np.sum(A.width**2)) // 2
    values = np.full(pattern.entries, np.nan)
    owner = np.repeat(np.arange(35), np.diff(A.ptr))
    for i, j, v, flip in zip(owner, A.neighbours, pattern.block, pattern.flip):
        B = A.dense[A.at[i] : A.at[i] + A.width[i], A.at[j] : A.at[j] + A.width[j]]
        values[v : v + B.size] = (B.T if flip else B).ravel()
    np.testing.assert_array_equal(pattern.matrix(values).toarray(), A.dense)
    b = rng.standard_normal(len(A.dense))
    np.testing.assert_allclose(pattern.factor(values).solve(b), np.linalg.solve(A.dense, b), atol=1e-12)


def test_blocks_as_csc_in_another_order(rng: np.random.Generator) -> None:
    A = blocks(rng, 25, 0.1)
    nodes = rng.permutation(25)
    C = csc_of_blocks(nodes, A.width, A.ptr, A.neighbours, A.block, np.zeros_like(A.block), A.values)
    scalars = np.concatenate([A.at[i] + np.arange(A.width[i]) for i in nodes])
    np.testing.assert_array_equal(C.toarray(), A.dense[np.ix_(scalars, scalars)])
    sorted_twin = C.copy()
    sorted_twin.has_sorted_indices = False
    sorted_twin.sort_indices()
    np.testing.assert_array_equal(C.indices, sorted_twin.indices)
