"""The ledger of loops: every decision with its reason and values, as events stored in the run folder."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from graphslam.core.errors import DataError
from graphslam.core.tables import data_frame
from graphslam.loops.candidates import FRONT_END

if TYPE_CHECKING:
    import pandas as pd

Verdict = Literal["accepted", "rejected", "switched-off", "undone"]
EVENT = "loop"
COLUMNS = (
    "loop",
    "verdict",
    "why",
    "source",
    "submap_i",
    "submap_j",
    "i",
    "j",
    "score",
    "gain",
    "fitness",
    "margin",
    "sigma",
    "chi2",
    "weight",
    "effect_predicted",
    "effect",
    "effect_earlier",
    "factor_id",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopDecision:
    """A decision on a loop, with its reasons; the latest decision on a loop is the current one.

    Parameters
    ----------
    loop : int
        Number of the loop in the ledger.
    verdict : {"accepted", "rejected", "switched-off", "undone"}
    why : str
        Reason as text.
    i, j : int
        Nodes.
    submap_i, submap_j : int
        Keys of their submaps.
    source : str
        Source of the candidate: ``front-end``, ``proximity``, ``appearance`` or ``overlap``.
    score, gain : float
        Of the candidate.
    gates : dict
        Values of its registration.
    chi2 : float
        Relative to the graph's joint marginal at the decision, later to the graph without the loop.
    weight : float
        Of the robust kernel at the solution; 0 for a loop that is not in the graph.
    effect_predicted : float
        Predicted increase of the objective: ``eᵀ (P + R)⁻¹ e``.
    effect : float
        Actual increase.
    effect_earlier : float
        Part of it in the factors that existed before.
    factor_id : int
        In the graph; −1 if it is not there.
    T_ij : list of float
        The measurement; empty if the registration failed.
    covariance : list of list of float
        Of it, right tangent.
    """

    loop: int
    verdict: Verdict
    why: str
    i: int
    j: int
    submap_i: int = -1
    submap_j: int = -1
    source: str = ""
    score: float = math.nan
    gain: float = math.nan
    gates: dict[str, Any] = field(default_factory=dict)
    chi2: float = math.nan
    weight: float = 0.0
    effect_predicted: float = math.nan
    effect: float = math.nan
    effect_earlier: float = math.nan
    factor_id: int = -1
    T_ij: list[float] = field(default_factory=list)
    covariance: list[list[float]] = field(default_factory=list)

    def event(self) -> dict[str, Any]:
        """One line of ``events.jsonl``."""
        return {"event": EVENT, **{name: getattr(self, name) for name in self.__slots__}}


class LoopLedger:
    """Decisions in chronological order.

    Examples
    --------
    >>> ledger = LoopLedger()
    >>> ledger.write(LoopDecision(loop=0, verdict="accepted", why="", i=3, j=40, factor_id=77))
    >>> ledger.write(LoopDecision(loop=0, verdict="undone", why="asked for", i=3, j=40))
    >>> ledger.current()[0].verdict
    'undone'
    """

    def __init__(self, decisions: Iterable[LoopDecision] = ()) -> None:
        self.decisions: list[LoopDecision] = list(decisions)

    @classmethod
    def from_events(cls, events: Iterable[Mapping[str, Any]], *, where: str = "events") -> LoopLedger:
        """The ledger of a run from its events; other events are ignored."""
        out = []
        names = set(LoopDecision.__slots__)
        for k, e in enumerate(events):
            if e.get("event") != EVENT:
                continue
            # not-a-number is null in JSON
            facts: dict[str, Any] = {n: math.nan if v is None else v for n, v in e.items() if n in names}
            try:
                out.append(LoopDecision(**facts))
            except TypeError as error:
                raise DataError(f"loop event {k} is not whole ({error})", where=where) from None
        return cls(out)

    def write(self, decision: LoopDecision) -> None:
        """Add a decision."""
        self.decisions.append(decision)

    def __len__(self) -> int:
        return len(self.decisions)

    def current(self) -> list[LoopDecision]:
        """The current decision on every loop, by its number."""
        last: dict[int, LoopDecision] = {}
        for d in self.decisions:
            last[d.loop] = d
        return [last[k] for k in sorted(last)]

    def of(self, loop: int) -> LoopDecision:
        """The current decision on one loop."""
        for d in reversed(self.decisions):
            if d.loop == loop:
                return d
        raise DataError(f"loop {loop} is not in the ledger", wanted=f"one of {len(self.current())} loops")

    def events(self) -> list[dict[str, Any]]:
        """All decisions as lines for ``events.jsonl``."""
        return [d.event() for d in self.decisions]

    def counts(self) -> dict[str, int]:
        """Number of loops by current decision."""
        out: dict[str, int] = {}
        for d in self.current():
            out[d.verdict] = out.get(d.verdict, 0) + 1
        return out

    def rows(self, *, history: bool = False) -> list[dict[str, Any]]:
        """One row per loop with its current decision, or with ``history`` one row per decision."""
        rows = []
        for d in self.decisions if history else self.current():
            row = d.event()
            gates = row.pop("gates") or {}
            row["sigma"] = max((P[k] for k, P in enumerate(d.covariance)), default=math.nan) ** 0.5
            row["fitness"] = gates.get("fitness_known") or gates.get("fitness", math.nan)
            row["margin"] = gates.get("margin", math.nan)
            rows.append({c: row.get(c) for c in COLUMNS})
        return rows

    def table(self, *, history: bool = False) -> pd.DataFrame:
        """:meth:`rows` as a pandas table."""
        return data_frame(self.rows(history=history), COLUMNS)


DECIDED = "decided on with all loops"
"""Reason for removing the factor of a front-end match that is then decided on like other loops."""


def ledger_of_events(events: Sequence[Mapping[str, Any]], *, where: str = "events") -> LoopLedger:
    """Ledger of all loops in the events of a graph; see :func:`loops_of_run`."""
    ledger = LoopLedger.from_events(events, where=where)
    number = 1 + max((d.loop for d in ledger.decisions), default=-1)
    removed = {e.get("factor_id"): str(e.get("reason", "")) for e in events if e.get("event") == "removed"}
    for e in events:
        match = _match(e, number, removed)
        if match is not None:
            ledger.write(match)
            number += 1
    return ledger


def _match(e: Mapping[str, Any], number: int, removed: Mapping[Any, str]) -> LoopDecision | None:
    """Decision on a front-end match that became a factor, or did not; None for other events."""
    used = e.get("event") == "between" and e.get("group") == "match"
    if not used and e.get("event") != "match-not-used":
        return None

    def figure(name: str) -> float:
        value = e.get(name)
        return math.nan if value is None else float(value)

    fid = int(e.get("factor_id", -1))
    undone = used and fid in removed
    if undone and removed[fid] == DECIDED:
        return None  # it is in the ledger as a loop
    support = figure("support")
    why = f"removed: {removed[fid]}" if undone else f"support {support:.2f}"
    return LoopDecision(
        loop=number,
        verdict="undone" if undone else "accepted" if used else "rejected",
        why=why if used else f"{why} is too little",
        i=int(e.get("i", -1)),
        j=int(e.get("j", -1)),
        submap_i=int(e.get("target", -1)),
        submap_j=int(e.get("submap", -1)),
        source=FRONT_END,
        score=support,
        gates={"fitness": figure("fitness")},
        weight=math.nan if used and not undone else 0.0,
        factor_id=-1 if undone or not used else fid,
    )


def same_loop(d: LoopDecision, ledger: LoopLedger) -> LoopDecision | None:
    """The accepted loop of another ledger with the same source, submaps and nodes; or None.

    Numbers may differ if other candidates were tested; of several loops the one with the same number is returned.
    """
    found = [x for x in ledger.current() if x.verdict == "accepted" and _identity(x) == _identity(d)]
    found.sort(key=lambda x: x.loop != d.loop)
    return found[0] if found else None


def _identity(d: LoopDecision) -> tuple[str, int, int, int, int]:
    return d.source, d.submap_i, d.submap_j, d.i, d.j
