"""Decide on loops: each is tested with the graph, with the other loops, and by its effect on the solution.

One wrong loop ruins a map, so a loop must pass these tests, in this order:

1. the gates of its registration (:mod:`graphslam.registration.gates`);
2. its χ² with the chain of submaps alone, and pairwise consistency: it is in the largest set of loops that are
   consistent with each other;
3. the χ² of its residual with the current joint marginal of the graph, most likely loops first;
4. the solution: a loop that raises the χ² of earlier factors significantly is removed, and after all loops were added,
   each is compared with the graph *without* it;
5. if a joint test of all loops keeps more loops than the graph has, they are exchanged
   (:mod:`~graphslam.loops.global_inlier_check`);
6. of two contradictory groups the one with the more consistent map overlap is accepted
   (:mod:`~graphslam.loops.map_overlap_test`); if the maps do not decide, the one that agrees better with the rest of
   the graph; if this is ambiguous, neither (:mod:`~graphslam.loops.conflicting_groups`).

With the residual r of a loop in the graph, its covariance R, and the posterior P of the relative pose, the graph
without it predicts r with covariance ``R - P``, so ``r' = R (R - P)⁻¹ r`` and its χ² is ``rᵀ (R - P)⁻¹ r``: no second
solution is needed. Every step writes a :class:`~graphslam.loops.ledger.LoopDecision`.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from graphslam.association.consistent_set import ConsistentSet, LoopArrays, OdometryChain, chain_chi2, consistent_loops
from graphslam.core.errors import DataError
from graphslam.core.gaussian import check_covariance, chi2_quantile
from graphslam.core.geometry import Array
from graphslam.core.poses import group_of
from graphslam.graph.noise import RobustKernel
from graphslam.loops.conflicting_groups import (
    AMBIGUOUS,
    CLASH,
    LOST,
    choose_group,
    find_conflicting_groups,
)
from graphslam.loops.global_inlier_check import truncated_least_squares_inliers
from graphslam.loops.ledger import LoopDecision, LoopLedger, Verdict
from graphslam.loops.map_overlap_test import MapCheck, disagreement_shares, overlap_log_likelihood_ratio
from graphslam.loops.measure import Loop
from graphslam.loops.places import Ints
from graphslam.loops.rules import JointTest, LoopConfig, LoopGraph, chi2_without
from graphslam.registration.search import last_value
from graphslam.registration.submap_pairs import prediction_chi2


class LoopCloser:
    """Decides on loops, and writes the loop ledger.

    Parameters
    ----------
    increments, covariances : (n, 7|3), (n, d, d)
        The chain alone, between nodes, right tangents, for pairwise consistency.
    ledger : LoopLedger, optional
        Earlier ledger to continue.
    joint_test : callable
        Joint inlier test of all loops, from increments, covariances, and loops (ends, poses, covariances) to a mask
        (:func:`graphslam.loops.global_inlier_check.truncated_least_squares_inliers`).
    map_check : callable, optional
        Contradiction between the maps of loops at relative poses of their ends
        (:mod:`graphslam.loops.map_overlap_test`).
    """

    def __init__(
        self,
        graph: LoopGraph,
        increments: Array,
        covariances: Array,
        config: LoopConfig | None = None,
        ledger: LoopLedger | None = None,
        joint_test: JointTest = truncated_least_squares_inliers,
        map_check: MapCheck | None = None,
    ) -> None:
        self.graph = graph
        self.increments, self.covariances = increments, covariances
        self.config = LoopConfig() if config is None else config
        self.ledger = LoopLedger() if ledger is None else ledger
        self.joint_test, self.map_check = joint_test, map_check
        self.loops: dict[int, Loop] = {}
        self._torn: list[tuple[list[int], list[int]]] = []
        self._untested = False  # by the joint test
        self._dof = group_of(increments).dof

    # ---------------------------------------------------------------- deciding

    def extend_chain(self, graph: LoopGraph, increments: Array, covariances: Array) -> None:
        """Continue with a longer chain and the same loops."""
        self.graph, self.increments, self.covariances = graph, increments, covariances

    @property
    def accepted(self) -> list[int]:
        """Numbers of the loops in the graph."""
        return [d.loop for d in self.ledger.current() if d.verdict == "accepted"]

    @property
    def undecided(self) -> list[tuple[list[int], list[int]]]:
        """Pairs of contradictory groups without a decision: neither is in the graph."""
        torn = {d.loop for d in self.ledger.current() if d.why.startswith(AMBIGUOUS)}
        pairs = [([n for n in a if n in torn], [n for n in b if n in torn]) for a, b in self._torn]
        return [(a, b) for a, b in pairs if a and b]

    @contextmanager
    def with_trial_loops(self, numbers: Sequence[int]) -> Iterator[list[int]]:
        """Context with additional loops, as far as the graph accepts them; removed at the end, not in the ledger."""
        inside: dict[int, int] = {}
        for _, n in sorted(zip(self._against_chain(list(numbers)), numbers)):
            verdict, _, facts = last_value(self._try(n))
            if verdict == "accepted":
                inside[n] = int(facts["factor_id"])
        try:
            yield sorted(inside)
        finally:
            for fid in inside.values():
                self.graph.remove_loop(fid)
            self.graph.solve()

    def propose(self, loops: Sequence[Loop]) -> list[LoopDecision]:
        """Decide on new loops, and again on accepted ones and on those rejected because of other loops.

        Returns
        -------
        list of LoopDecision
            Current decisions on the new ones, in their order.
        """
        return last_value(self.propose_in_slices(loops))

    def propose_in_slices(
        self, loops: Sequence[Loop], *, joint: bool = True
    ) -> Generator[None, None, list[LoopDecision]]:
        """:meth:`propose` in slices of a few solutions; the graph must not be changed in between.

        The joint test of all loops, one long call, is left to a later proposal unless ``joint``.
        """
        first = 1 + max((d.loop for d in self.ledger.decisions), default=-1)
        numbers = list(range(first, first + len(loops)))
        usable = []
        for n, loop in zip(numbers, loops):
            self.loops[n] = loop
            if loop.why:
                self._write(n, "rejected", f"registration: {loop.why}")
            else:
                check_covariance(loop.covariance, what=f"covariance of loop {n}", dim=self._dof)
                usable.append(n)
        if usable or (joint and self._untested):
            yield from self._decide(usable, joint)
        return [self.ledger.of(n) for n in numbers]

    def undo(self, loop: int, why: str = "asked for") -> LoopDecision:
        """Remove a loop from the graph, and solve without it."""
        d = self.ledger.of(loop)
        if d.verdict != "accepted":
            raise DataError(f"loop {loop} is not in the graph", got=d.verdict, wanted="an accepted loop")
        before = sum(self.graph.chi2().values())
        self.graph.remove_loop(d.factor_id)
        self.graph.solve()
        effect = sum(self.graph.chi2().values()) - before
        self.ledger.write(replace(d, verdict="undone", why=why, weight=0.0, factor_id=-1, effect=effect))
        return self.ledger.of(loop)

    def _decide(self, new: list[int], joint: bool) -> Generator[None, None, None]:
        """Rounds: loops that the graph rejects no longer take part in pairwise consistency."""
        out: set[int] = set()
        self._torn = []  # loops that lost a dispute are decided on again
        while True:
            refused = yield from self._round(new, out)
            refused |= yield from self._reconsider()
            if not refused:
                break
            out |= refused
        self._untested = not joint
        if joint and self._exchange_by_joint_test():
            yield from self._reconsider()
        seen: list[list[int]] = []
        while self.accepted not in seen:  # removing one group may start a dispute with the next one
            seen.append(self.accepted)
            yield
            if self._disputes():
                yield from self._reconsider()
                if self.map_check is not None:
                    resolved = {d.loop for d in self.ledger.current() if d.why.startswith(LOST)}
                    yield from self._round([], resolved)
                    yield from self._reconsider()
        self._report_weights()

    def _round(self, new: list[int], out: set[int]) -> Generator[None, None, set[int]]:
        """One round over all loops except ``out``; returns consistent loops that the graph rejected."""
        # loops that were inconsistent with others may be accepted with more loops
        again = [n for n in self._refused_by_company() if n not in new]
        numbers = [n for n in sorted({*new, *self.accepted, *again}) if n not in out]
        if not numbers:
            return set()
        chain = dict(zip(numbers, self._against_chain(numbers)))
        limit = chi2_quantile(self.config.chain, self._dof)
        inside = set(self.accepted)
        for n in numbers:
            if n not in inside and not chain[n] <= limit:
                self._refuse(n, f"chain: χ² {chain[n]:.1f} > {limit:.1f}", chain[n])
        numbers = [n for n in numbers if n in inside or chain[n] <= limit]
        if not numbers:
            return set()
        found = self._consistent(numbers)
        left = []
        for k, n in enumerate(numbers):
            if found.accepted[k]:
                if n not in inside:
                    left.append((chain[n], n))
            elif n in inside:
                self.switch_off(n, f"pairwise: {found.reasons[k]}")
            else:
                self._refuse(n, f"pairwise: {found.reasons[k]}", chain[n])
        tried = [n for _, n in sorted(left)]
        yield from self._one_by_one(tried)
        return set(tried) - set(self.accepted)

    def _refuse(self, n: int, why: str, chi2: float) -> None:
        """Write a rejection, unless it is the latest decision already."""
        last = [d for d in self.ledger.decisions if d.loop == n][-1:]
        if not last or last[0].why != why:
            self._write(n, "rejected", why, chi2=chi2)

    def _one_by_one(self, numbers: list[int]) -> Generator[None, None, None]:
        for n in numbers:  # each with the current graph
            yield
            verdict, why, facts = yield from self._try(n)
            self._write(n, verdict, why, **facts)

    def _try(self, n: int) -> Generator[None, None, tuple[Verdict, str, dict[str, float]]]:
        """Add one loop if the graph accepts it: decision, reason, values."""
        c, d, loop = self.config, self._dof, self.loops[n]
        limit = chi2_quantile(c.level, d)
        earlier_limit = chi2_quantile(c.earlier, d)
        expected = float(self._against_graph([n])[0])
        if not expected <= limit:  # NaN is not
            return "rejected", f"graph: χ² {expected:.1f} > {limit:.1f}", {"chi2": expected}
        yield
        before = self.graph.chi2()
        fid = self.graph.add_loop(loop, self._kernel())
        self.graph.solve()
        yield
        after = self.graph.chi2()
        effect = sum(after.values()) - sum(before.values())
        earlier = sum(after[f] - before[f] for f in before)
        facts = {"chi2": expected, "effect_predicted": expected, "effect": effect, "effect_earlier": earlier}
        if not earlier <= earlier_limit:
            self.graph.remove_loop(fid)
            self.graph.solve()
            worst = max(before, key=lambda f: after[f] - before[f])
            why = f"effect: χ² of earlier factors rises by {earlier:.1f} > {earlier_limit:.1f} (most: factor {worst})"
            return "switched-off", why, facts
        weight = float(self._kernel().weight(np.array([after[fid]]))[0])
        return "accepted", acceptance_reason(expected, d), {**facts, "factor_id": fid, "weight": weight}

    def _exchange_by_joint_test(self) -> bool:
        """Exchange loops in the graph for others, if a test of all together, in no order, keeps more than there are."""
        inside = self.accepted
        asked = sorted({*inside, *(n for n in self._refused_by_company() if self._bears(n))})
        if not inside or len(asked) < 2:
            return False
        good = self.joint_test(self.increments, self.covariances, self._arrays(asked))
        believed = {n for n, yes in zip(asked, good) if yes}
        rivals, outside = [n for n in inside if n not in believed], sorted(believed - set(inside))
        return len(outside) > len(rivals) > 0 and self._swap(rivals, outside)

    def _swap(self, rivals: list[int], outside: list[int]) -> bool:
        """Replace loops by others; undone if not more of them are accepted."""
        for n in rivals:
            self.graph.remove_loop(self.ledger.of(n).factor_id)
        self.graph.solve()
        added = {}
        for _, n in sorted(zip(self._against_chain(outside), outside)):
            verdict, why, facts = last_value(self._try(n))
            if verdict == "accepted":
                added[n] = (why, facts)
        if len(added) > len(rivals):
            for n in rivals:
                why = f"exchange: shut out {len(added)} that agree with each other, {len(rivals)} did"
                self.ledger.write(replace(self.ledger.of(n), verdict="switched-off", why=why, weight=0.0, factor_id=-1))
            for n, (why, facts) in added.items():
                self._write(n, "accepted", why, **facts)
            return True
        for _, facts in added.values():
            self.graph.remove_loop(int(facts["factor_id"]))
        for n in rivals:
            fid = self.graph.add_loop(self.loops[n], self._kernel())
            self.ledger.write(replace(self.ledger.of(n), factor_id=fid))
        self.graph.solve()
        return False

    def _disputes(self) -> bool:
        """Decide between contradictory groups: accept the one that agrees with the rest of the graph, or neither."""
        inside = self.accepted
        outside = [n for n in self._refused_by_company() if self._bears(n)]
        least = 2 if self.map_check is None else 1  # maps can decide on a single loop
        if not inside or len(outside) < least:
            return False
        both = [*inside, *outside]
        ends = self._arrays(both)[0]
        limit = chi2_quantile(CLASH, self._dof)
        changed = False
        for rows, columns in find_conflicting_groups(self._consistent(both).chi2, len(inside), ends, limit, least):
            a, b = [both[k] for k in rows], [both[k] for k in columns]
            if not set(a) <= set(self.accepted):
                continue  # changed by another dispute
            with_a = self._relative([*a, *b])
            for n in a:
                self.graph.remove_loop(self.ledger.of(n).factor_id)
            self.graph.solve()
            other = self._against_graph(b)
            outcome, why = choose_group(self._against_graph(a), other, self._map_evidence(a, b, with_a))
            for n in a:
                d = self.ledger.of(n)
                if outcome == "stays":
                    fid = self.graph.add_loop(self.loops[n], self._kernel())
                    self.ledger.write(replace(d, factor_id=fid))
                else:
                    self.ledger.write(replace(d, verdict="switched-off", why=why, weight=0.0, factor_id=-1))
            if outcome == "changes":
                last_value(self._one_by_one(b))
            elif outcome == "ambiguous":
                self._torn.append((a, b))
                for n, value in zip(b, other):
                    self._refuse(n, why, float(value))
            self.graph.solve()
            changed |= outcome != "stays"
        return changed

    def _map_evidence(self, a: list[int], b: list[int], with_a: Array) -> float:
        """Log-likelihood ratio of the maps with the loops b to those with a; neither is in the graph.

        Parameters
        ----------
        with_a : (k, 7|3)
            Relative poses of the ends of all of them in the solution with a.
        """
        others = [n for n in self.accepted if n not in a]
        if self.map_check is None or not others:
            return 0.0
        factors = [self.graph.add_loop(self.loops[n], self._kernel()) for n in b]
        self.graph.solve()
        with_b = self._relative([*a, *b])
        for f in factors:
            self.graph.remove_loop(f)
        self.graph.solve()
        asked, calm = [self.loops[n] for n in [*a, *b]], [self.loops[n] for n in others]
        at, g = self._relative(others), group_of(with_a)
        D = g.between(with_a, with_b)
        # move undisputed loops by the differences between the two solutions, in turn, in both directions
        D = np.concatenate([D, g.inverse(D)])
        moved = g.compose(at, D[np.arange(len(at)) % len(D)])
        shares = [self.map_check(x, T) for x, T in ((calm, at), (calm, moved), (asked, with_b), (asked, with_a))]
        return overlap_log_likelihood_ratio(
            *(disagreement_shares(x, s) for x, s in zip((calm, calm, asked, asked), shares))
        )

    def _relative(self, numbers: list[int]) -> Array:
        """Relative poses of the ends of loops in the current graph ``(k, 7|3)``."""
        x = [self.loops[n] for n in numbers]
        return self.graph.relative(np.array([a.i for a in x]), np.array([a.j for a in x]))[0]

    def _against_graph(self, numbers: list[int]) -> Array:
        """χ² of loops that are not in the graph, each separately ``(k,)``."""
        x = [self.loops[n] for n in numbers]
        T, P = self.graph.relative(np.array([a.i for a in x]), np.array([a.j for a in x]))
        return np.array([prediction_chi2(a.T_ij, a.covariance, T[k], P[k]) for k, a in enumerate(x)])

    def _bears(self, n: int) -> bool:
        """Is a loop consistent with the chain alone?"""
        return self._against_chain([n])[0] <= chi2_quantile(self.config.chain, self._dof)

    def _reconsider(self) -> Generator[None, None, set[int]]:
        """Switch off loops that the rest of the graph contradicts, worst first; returns their numbers."""
        limit = chi2_quantile(self.config.off, self._dof)
        removed: set[int] = set()
        while inside := self.accepted:
            yield
            alone = self.without(inside)
            worst = int(np.argmax(alone))
            if not alone[worst] > limit:
                break
            n = inside[worst]
            self.switch_off(n, f"the graph without it: χ² {alone[worst]:.1f} > {limit:.1f}", float(alone[worst]))
            removed.add(n)
        return removed

    def _report_weights(self) -> None:
        """Write the weights of the kernels, which have changed since loops were accepted."""
        chi2 = self.graph.chi2()
        for n in self.accepted:
            d = self.ledger.of(n)
            weight = float(self._kernel().weight(np.array([chi2[d.factor_id]]))[0])
            if abs(weight - d.weight) > 0.01:
                self.ledger.write(replace(d, weight=weight))

    def without(self, numbers: Sequence[int]) -> Array:
        """χ² of loops in the graph relative to the graph without them ``(k,)``, each separately.

        ``rᵀ (R - P)⁻¹ r`` with the residual r and the posterior P of the relative pose
        (:func:`~graphslam.loops.rules.chi2_without`).
        """
        loops = [self.loops[n] for n in numbers]
        T, P = self.graph.relative(np.array([x.i for x in loops]), np.array([x.j for x in loops]))
        return np.array([chi2_without(x, T[k], P[k]) for k, x in enumerate(loops)])

    # ---------------------------------------------------------------- writing

    def switch_off(self, n: int, why: str, chi2: float = math.nan) -> None:
        """Remove a contradicted loop from the graph, and solve without it."""
        d = self.ledger.of(n)
        before = sum(self.graph.chi2().values())
        self.graph.remove_loop(d.factor_id)
        self.graph.solve()
        effect = sum(self.graph.chi2().values()) - before
        value = d.chi2 if math.isnan(chi2) else chi2
        self.ledger.write(
            replace(d, verdict="switched-off", why=why, weight=0.0, factor_id=-1, effect=effect, chi2=value)
        )

    def _write(self, n: int, verdict: Verdict, why: str, **facts: float) -> None:
        x = self.loops[n]
        known: dict[str, float] = dict(facts)
        measured = bool(np.all(np.isfinite(x.covariance)))
        fid = int(known.pop("factor_id", -1))
        self.ledger.write(
            LoopDecision(
                loop=n, verdict=verdict, why=why, i=int(x.i), j=int(x.j), submap_i=int(x.submaps[0]),
                submap_j=int(x.submaps[1]), source=x.source, score=x.score, gain=x.gain, gates=x.gates, factor_id=fid,
                T_ij=x.T_ij.tolist() if measured else [], covariance=x.covariance.tolist() if measured else [],
                **known,
            )  # type: ignore[arg-type]
        )  # fmt: skip

    def _refused_by_company(self) -> list[int]:
        verdicts = ("rejected", "switched-off")
        return [
            d.loop
            for d in self.ledger.current()
            if d.verdict in verdicts and d.loop in self.loops and not self.loops[d.loop].why
        ]

    def _arrays(self, numbers: list[int]) -> tuple[Ints, Array, Array]:
        x = [self.loops[n] for n in numbers]
        ends = np.array([[a.i, a.j] for a in x], dtype=np.int64)
        return ends, np.stack([a.T_ij for a in x]), np.stack([a.covariance for a in x])

    def _against_chain(self, numbers: list[int]) -> list[float]:
        chain = OdometryChain.of(self.increments, self.covariances)
        return [float(v) for v in chain_chi2(chain, LoopArrays.of(chain, *self._arrays(numbers)))]

    def _consistent(self, numbers: list[int]) -> ConsistentSet:
        return consistent_loops(
            self.increments, self.covariances, self._arrays(numbers), self.config.pairwise, against_chain=False
        )

    def _kernel(self) -> RobustKernel:
        return self.config.robust(self._dof)


def acceptance_reason(chi2: float, dof: int) -> str:
    """Reason for the acceptance of a loop, as text."""
    return f"agrees with the graph: χ² {chi2:.1f} of {dof}"
