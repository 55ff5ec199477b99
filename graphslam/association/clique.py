"""Maximum clique: exact by branch and bound where that is feasible, else the best one found and an upper bound.

Branch and bound with the greedy-colouring bound of Tomita & Seki (2003, MCQ): the vertices of a clique all have
different colours, so a set that can be coloured with k colours contains no clique larger than k. Sets are Python
integers used as bit sets.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from graphslam.core.errors import GeometryError

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Clique:
    """The largest clique found.

    Parameters
    ----------
    members : (n,) bool
    bound : int
        No clique is larger. ``size == bound`` proves that this one is a maximum.
    """

    members: Mask
    size: int
    bound: int

    @property
    def exact(self) -> bool:
        """Whether it is proved that no clique is larger."""
        return self.size == self.bound


def maximum_clique(adjacent: npt.ArrayLike, *, budget: int = 200_000) -> Clique:
    """Largest set of vertices of which every two are adjacent.

    Parameters
    ----------
    adjacent : (n, n) bool
        Symmetric; the diagonal is ignored.
    budget : int
        Maximum number of branches; then the best clique so far and a bound are returned. The greedy clique uses none.

    Returns
    -------
    Clique
        Deterministic, also if there are several maximum cliques.
    """
    A = np.array(adjacent, dtype=np.bool_)
    if A.ndim != 2 or A.shape[0] != A.shape[1] or not (A == A.T).all():
        raise GeometryError("adjacency must be a symmetric matrix", got=A.shape, wanted="(n, n), symmetric")
    n = len(A)
    np.fill_diagonal(A, False)
    if n == 0:
        return Clique(np.zeros(0, dtype=np.bool_), 0, 0)
    # vertices of small degree first: colours are given from the last, where the large ones then are
    order = _degeneracy_order(A)
    packed = A[np.ix_(order, order)]
    rows = [int.from_bytes(np.packbits(row, bitorder="little").tobytes(), "little") for row in packed]
    best = _greedy(rows, n)
    bound = len(_colour_classes(rows, (1 << n) - 1))
    search = _Search(rows, best, budget)
    if best.bit_count() < bound:
        search.expand(0, (1 << n) - 1)
        best = search.best
        bound = bound if search.exhausted else best.bit_count()
    members = np.zeros(n, dtype=np.bool_)
    members[order[[k for k in range(n) if best >> k & 1]]] = True
    return Clique(members, best.bit_count(), bound)


def _degeneracy_order(A: Mask) -> npt.NDArray[np.intp]:
    """Degeneracy order: repeatedly remove the vertex with the fewest remaining neighbours."""
    degree = A.sum(axis=1).astype(np.int64)
    order = np.empty(len(A), dtype=np.intp)
    for k in range(len(A)):
        v = int(np.argmin(degree))
        order[k] = v
        degree -= A[v]
        degree[v] = np.iinfo(np.int64).max // 2
    return order


def _greedy(rows: list[int], n: int) -> int:
    """Greedy clique from each of the vertices of highest degree: add the candidate with most neighbouring
    candidates."""
    best = 0
    for start in sorted(range(n), key=lambda v: -rows[v].bit_count())[: min(n, 20)]:
        clique, candidates = 1 << start, rows[start]
        while candidates:
            v = max(_bits(candidates), key=lambda u: (rows[u] & candidates).bit_count())
            clique |= 1 << v
            candidates &= rows[v]
        if clique.bit_count() > best.bit_count():
            best = clique
    return best


def _bits(x: int) -> list[int]:
    out = []
    while x:
        low = x & -x
        out.append(low.bit_length() - 1)
        x ^= low
    return out


def _colour_classes(rows: list[int], candidates: int) -> list[list[int]]:
    """Sets of vertices without an edge inside, covering the candidates, largest vertex first."""
    classes = []
    while candidates:
        free, colour = candidates, []
        while free:
            v = free.bit_length() - 1
            colour.append(v)
            free &= ~(rows[v] | (1 << v))
        for v in colour:
            candidates &= ~(1 << v)
        classes.append(colour)
    return classes


class _Search:
    def __init__(self, rows: list[int], best: int, budget: int) -> None:
        self.rows, self.best, self.budget = rows, best, budget
        self.exhausted = False

    def expand(self, clique: int, candidates: int) -> None:
        """Depth first, on a stack of its own: cliques can be larger than Python's recursion limit."""
        stack = [(clique, candidates, self._ordered(candidates))]
        while stack:
            clique, candidates, ordered = stack[-1]
            have = clique.bit_count()
            if not ordered or have + ordered[-1][1] <= self.best.bit_count():
                stack.pop()
                continue
            v, _ = ordered.pop()
            if self.budget <= 0:
                self.exhausted = True
                return
            self.budget -= 1
            larger, rest = clique | (1 << v), candidates & self.rows[v]
            stack[-1] = (clique, candidates & ~(1 << v), ordered)
            if rest:
                stack.append((larger, rest, self._ordered(rest)))
            elif have + 1 > self.best.bit_count():
                self.best = larger

    def _ordered(self, candidates: int) -> list[tuple[int, int]]:
        """Candidates by colour: (vertex, colours up to and including its own)."""
        return [(v, k + 1) for k, c in enumerate(_colour_classes(self.rows, candidates)) for v in c]
