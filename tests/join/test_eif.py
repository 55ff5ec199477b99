"""One join of two maps (eq. 13–16): matching, news and its absence, what a landmark became, and the order it keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphslam.core.geometry import se2_compose, se2_transform
from graphslam.core.submap import LandmarkMap, Submap
from graphslam.join import eif, kernels
from graphslam.join.joined_map import JoinedMap, JoinTimes
from graphslam.join.order import join_sequential, join_tree
from tests.reference.dense_join import BentMap, bent_join, bent_leaf, dense_information_join, dense_tree_join
from tests.reference.submap_chain import random_covariance, submap_chain


def leaf(key: int, ids: list[int], positions: list[list[float]], exit_pose: list[float], seed: int = 0) -> JoinedMap:
    """A submap of given landmarks with a full covariance, as a joined map."""
    n = 3 + 2 * len(ids)
    P = random_covariance(np.random.default_rng(seed), np.array([0.05, 0.05, 0.005] + [0.05] * (n - 3)))
    m = LandmarkMap(ids=ids, exit_pose=exit_pose, positions=np.reshape(positions, (-1, 2)), covariance=P)
    return JoinedMap.leaf(Submap.from_landmarks(key, m, interval=(float(key), key + 1.0)), identified=True)


A_EXIT = [4.0, 1.0, 0.4]


def two(seed: int = 0, off: float = 0.05) -> tuple[JoinedMap, JoinedMap]:
    """Landmarks 7, 3, 9; then 11, 3, 2, 9, which sees 3 and 9 again, ``off`` metres away from where A has them."""
    known = np.array([[1.0, 2.0], [3.0, -1.0], [5.0, 2.0]])
    a = leaf(0, [7, 3, 9], known.tolist(), A_EXIT, seed)
    back = se2_transform(se2_compose(np.zeros(3), _inverse(A_EXIT)), known[[1, 2]]) + off
    b = leaf(
        1, [11, 3, 2, 9], [[1.0, 1.0], back[0].tolist(), [2.0, -2.0], back[1].tolist()], [3.0, 0.5, -0.2], seed + 1
    )
    return a, b


def _inverse(T: list[float]) -> np.ndarray:
    x, y, t = T
    c, s = np.cos(t), np.sin(t)
    return np.array([-c * x - s * y, s * x - c * y, -t])


@pytest.mark.parametrize("seed", range(20))
def test_landmarks_are_matched_by_id_as_a_dictionary_would(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (rng.permutation(30)[: rng.integers(0, 12)].tolist() for _ in range(2))
    maps = [leaf(k, ids, rng.normal(size=(len(ids), 2)).tolist(), [1.0, 0.0, 0.0]) for k, ids in enumerate((a, b))]
    place = {j: k for k, j in enumerate(a)}
    match = eif.match_by_id(*maps)
    assert match.tolist() == [place.get(j, -1) for j in b]
    assert match.dtype == np.intp


@pytest.mark.parametrize("count", [2, 5])
def test_small_chains_are_joined_as_the_equations_say(count: int, rng: np.random.Generator) -> None:
    """One after the other, and as a tree, whose right halves are maps of several poses."""
    chain = submap_chain(rng, submaps=5, landmarks=9, reach=30.0)[0][:count]
    X, I, ids = dense_information_join(chain)
    joined = join_sequential(chain)
    assert list(joined.landmark_ids) == ids
    headings = slice(2, 3 * count, 3)
    X[headings] = np.arctan2(np.sin(X[headings]), np.cos(X[headings]))
    np.testing.assert_allclose(joined.vector, X, atol=1e-9)
    np.testing.assert_allclose(joined.information.toarray(), I, rtol=0, atol=1e-9 * np.abs(I).max())
    names, X, I = dense_tree_join(chain)
    tree = join_tree(chain)
    begin = dict(zip(names, np.cumsum([0] + [3 if kind == "pose" else 2 for kind, _ in names])))
    at = [begin["pose", k] + i for k in range(count) for i in range(3)]
    at += [begin["landmark", int(j)] + i for j in tree.landmark_ids for i in range(2)]
    X = X[at]
    X[headings] = np.arctan2(np.sin(X[headings]), np.cos(X[headings]))
    np.testing.assert_allclose(tree.vector, X, atol=1e-8)
    # the twin's Jacobians are differences
    np.testing.assert_allclose(tree.information.toarray(), I[np.ix_(at, at)], rtol=0, atol=1e-7 * np.abs(I).max())


@pytest.mark.parametrize("count", [2, 6])
def test_joins_along_arcs_are_the_least_squares_of_both_maps(count: int, rng: np.random.Generator) -> None:
    """One after the other and as a tree, against dense least squares in the chart with numerical Jacobians."""
    chain = submap_chain(rng, submaps=6, landmarks=11, reach=30.0, sigma=0.02, sigma_heading=0.04, chart="group")[0][
        :count
    ]
    leaves = [bent_leaf(k, s) for k, s in enumerate(chain)]
    twin = leaves[0]
    for leaf_ in leaves[1:]:
        twin = bent_join(twin, leaf_)
    level = leaves
    while len(level) > 1:
        level = [bent_join(a, b) for a, b in zip(level[::2], level[1::2])] + level[len(level) - len(level) % 2 :]
    for joined, slow in ((join_sequential(chain), twin), (join_tree(chain), level[0])):
        begin = slow.begin()
        at = [begin["pose", k] + i for k in range(count) for i in range(3)]
        at += [begin["landmark", int(j)] + i for j in joined.landmark_ids for i in range(2)]
        X = slow.x[at]
        X[2 : 3 * count : 3] = np.arctan2(np.sin(X[2 : 3 * count : 3]), np.cos(X[2 : 3 * count : 3]))
        I = slow.information[np.ix_(at, at)]
        sigma = np.sqrt(np.diag(np.linalg.inv(I)))
        # three passes, and none after a step of a thousandth of a standard deviation
        np.testing.assert_allclose((joined.vector - X) / sigma, 0.0, atol=2e-3)
        np.testing.assert_allclose(joined.information.toarray(), I, rtol=0, atol=2e-3 * np.abs(I).max())
        hangs = [slow.anchor["landmark", int(j)][1] for j in joined.landmark_ids]
        assert joined.anchors.tolist() == hangs
        assert joined.chart == "group"


def test_a_map_is_pulled_back_as_its_chart_says(rng: np.random.Generator) -> None:
    """``Jᵀ I J`` and ``Jᵀ I u`` of a joined map at other values, against numerical differences of the chart; the
    pattern holds all of it, both ways."""
    chain = submap_chain(rng, submaps=4, landmarks=9, reach=30.0, sigma_heading=0.1, chart="group")[0]
    m, slow = JoinedMap.leaf(chain[0], identified=True), bent_leaf(0, chain[0])
    for k, s in enumerate(chain[1:], start=1):
        m, slow = (
            eif.join_maps(m, b := JoinedMap.leaf(s, identified=True), eif.match_by_id(m, b)),
            bent_join(slow, bent_leaf(k, s), passes=1),
        )
    here = replace_values(slow, m)
    x = m.x + rng.normal(0, 0.4, len(m.x))
    blocks, gradient = kernels.relinearise_in_chart(eif.block_map_of(m), m.anchor, x)
    u = here.difference(x)
    J = np.stack([(here.difference(x + h) - here.difference(x - h)) / 2e-6 for h in 1e-6 * np.eye(len(x))], axis=1)
    I = here.information
    at = replace(m, ptr=blocks.ptr, neighbours=blocks.idx, block=blocks.block, values=blocks.value, x=x)
    np.testing.assert_allclose(at.information().toarray(), J.T @ I @ J, rtol=0, atol=1e-7 * np.abs(I).max())
    np.testing.assert_allclose(gradient, J.T @ I @ u, rtol=0, atol=1e-7 * np.abs(J.T @ I @ u).max())


def replace_values(slow: BentMap, m: JoinedMap) -> BentMap:
    """The dense twin's parts in the order of the sparse map, with its mean and information."""
    kinds = {int(n): ("pose", k) for k, n in enumerate(m.pose_node)}
    kinds |= {int(n): ("landmark", int(j)) for n, j in zip(m.landmark_node, m.ids)}
    names = [kinds[n] for n in range(len(m.width))]
    assert {n: slow.anchor[n] for n in names} == {n: names[int(m.anchor[i])] for i, n in enumerate(names)}
    return BentMap(names, m.x, m.information().toarray(), slow.anchor)


def test_what_each_entry_became_and_where_new_nodes_stand() -> None:
    a, b = two()
    times = JoinTimes()
    joined = eif.join_maps(a, b, eif.match_by_id(a, b), times)
    assert times.parts["update"] > 0.0
    assert times.parts["recovery"] > 0.0
    assert joined.ids.tolist() == [7, 3, 9, 11, 2]
    assert [e.tolist() for e in joined.entries] == [[0, 1, 2], [3, 1, 4, 2]]
    # nodes: those of A, the end pose of B, and what is new in the order of B
    assert joined.pose_node.tolist() == [0, 4]
    assert joined.landmark_node.tolist() == [1, 2, 3, 5, 6]
    assert joined.width.tolist() == [3, 2, 2, 2, 3, 2, 2]
    assert sorted(joined.order.tolist()) == list(range(7))
    assert joined.order[:4].tolist() == a.order.tolist()
    # a second time, from a map of two poses: B starts at the last of them
    third = leaf(2, [7, 20], [[-1.0, 3.0], [1.0, 1.0]], [2.0, 0.0, 0.1], 5)
    alone = eif.join_maps(joined, third, np.array([-1, -1]))
    np.testing.assert_allclose(alone.pose(), se2_compose(joined.pose(), [2.0, 0.0, 0.1]), atol=1e-12)
    assert alone.entries[2].tolist() == [5, 6]
    both = eif.join_maps(joined, third, eif.match_by_id(joined, third))
    assert both.entries[2].tolist() == [0, 5]


def test_joining_gains_information_and_takes_none_from_anybody() -> None:
    """Of what A knew nothing is lost: I_joined - I_A is positive semi-definite, and B adds its own rank."""
    a, b = two()
    joined = eif.join_maps(a, b, eif.match_by_id(a, b))
    n, old = len(joined.x), len(a.x)
    before = np.zeros((n, n))
    before[:old, :old] = a.information().toarray()
    gained = np.linalg.eigvalsh(joined.information().toarray() - before)
    assert gained[0] > -1e-9 * gained[-1]
    assert np.sum(gained > 1e-9 * gained[-1]) == len(b.x)


@pytest.mark.parametrize("value", [0.0, 4.0])
@pytest.mark.parametrize(("part", "news"), [(0.7, False), (1.5, True)])
def test_a_difference_below_rounding_is_no_news(part: float, news: bool, value: float) -> None:
    """Positions of some metres carry errors of arithmetic of a few 1e-16 each; 1e-12 of (1 + the value) leaves room for
    thousands of joins and is a picometre to a robot. Smaller differences cost no factorisation and move nothing."""
    a = leaf(0, [7], [[2.0, value]], [0.0, 0.0, 0.0])
    b = leaf(1, [7], [[2.0, value + (1.0 + value) * part * 1e-12]], [1.0, 0.0, 0.0], 1)
    times = JoinTimes()
    joined = eif.join_maps(a, b, np.array([0]), times)
    assert (times.parts["recovery"] > 0.0) == news
    assert bool(np.any(joined.x[: len(a.x)] != a.x)) == news


@pytest.mark.parametrize(("growth", "fresh"), [(1.2, False), (1.45, True)])
def test_an_order_is_given_up_when_it_fills_in_a_third_more(
    growth: float, fresh: bool, rng: np.random.Generator
) -> None:
    """The time of a factorisation goes about with the square of what fills in: at 1.3 it is 1.7 times that of a fresh
    order. Much less would look for an order at every join, much more would hardly ever find one worth it."""
    a, b = two()
    joined = eif.join_maps(a, b, np.full(4, -1))
    joined = replace(joined, order=rng.permutation(joined.order))
    ratio = joined.symbolic().nnz / len(joined.values)
    joined.fill = ratio / growth
    kept = joined.order.copy()
    eif._keep_order_sparse(joined)
    assert (joined.fill != ratio / growth) == fresh
    if fresh:
        assert sorted(joined.order) == sorted(kept)
        assert joined.fill == pytest.approx(joined.symbolic().nnz / len(joined.values))
        assert joined.fill <= ratio
    else:
        np.testing.assert_array_equal(joined.order, kept)


def test_every_join_that_needs_a_factor_looks_after_its_order() -> None:
    a, b = two()
    a.fill = b.fill = 1e-3  # as if the last fresh order had been far better
    joined = eif.join_maps(a, b, eif.match_by_id(a, b))
    assert joined.fill == pytest.approx(joined.symbolic().nnz / len(joined.values))
    np.testing.assert_allclose(joined.x, eif.join_maps(*two(), eif.match_by_id(a, b)).x, atol=1e-12)


def test_a_fresh_order_of_a_long_map_fills_in_little(rng: np.random.Generator) -> None:
    """Sixty links end to end: any good order leaves a factor about as sparse as the matrix; a random one does not."""
    chain = [
        Submap(key=k, interval=(k, k + 1.0), exit_pose=[1.0, 0, 0], exit_covariance=1e-4 * np.eye(3)) for k in range(60)
    ]
    joined = JoinedMap.leaf(chain[0], identified=True)
    for s in chain[1:]:
        joined = eif.join_maps(joined, JoinedMap.leaf(s, identified=True), np.zeros(0, dtype=np.intp))
    joined = replace(joined, order=rng.permutation(joined.order))
    before = joined.symbolic().nnz
    eif._keep_order_sparse(joined)
    assert joined.symbolic().nnz < 0.7 * before
    assert joined.symbolic().nnz < 1.2 * len(joined.values)


@pytest.mark.parametrize("which", ["both", "a", "b"])
def test_ranks_of_a_tree_order_are_followed_only_where_both_maps_have_them(which: str) -> None:
    """Order by ranks of all that will ever be joined; then no other order is looked for, however stale."""
    a, b = two()
    ranks = [2, 9, 3, 4], [8, 7, 3, 5, 4]  # of landmarks 3 and 9 the same in both
    for m, rank in zip((a, b), ranks):
        if which in ("both", "ab"[m is b]):
            m.rank = np.array(rank, dtype=np.int64)
            m.order = np.argsort(m.rank)
    a.fill, b.fill = 0.2, 1e-3
    none = np.zeros(len(b.x))
    joined, gradient, _ = eif._assemble(a, b, eif.match_by_id(a, b), eif.block_map_of(a), eif.block_map_of(b), none)
    assert gradient is not None
    assert joined.fill == 0.2  # the larger: what the worse of the two was worth when it was fresh
    if which == "both":
        assert joined.rank is not None
        assert joined.rank.tolist() == [2, 9, 3, 4, 8, 7, 5]
        assert joined.order.tolist() == np.argsort([2, 9, 3, 4, 8, 7, 5]).tolist()
        eif._keep_order_sparse(joined)
        assert joined.fill == 0.2
    else:
        assert joined.rank is None
        assert joined.order.tolist() == [
            *a.order.tolist(),
            *(n for n in [[4, 5, 2, 6, 3][k] for k in b.order] if n > 3),
        ]
        eif._keep_order_sparse(joined)
        assert joined.fill != 0.2
