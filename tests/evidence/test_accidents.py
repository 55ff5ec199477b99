"""Memory that runs out and Ctrl-C at any moment: each grid is as before or as after, nothing is lost in the pool."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import graphslam.evidence
from graphslam.evidence import pool as pool_module
from graphslam.evidence import scratch as scratch_module
from graphslam.evidence.batch import update_grids
from graphslam.evidence.compact import compact_grids
from graphslam.evidence.pool import OF_BRICKS, OF_NODES, GridPool
from tests.reference.evidence_pool import assert_same, check_pool
from tests.reference.evidence_twin import EvidenceTwin
from tests.reference.evidence_world import ORIGIN, World


def _insert_one(w: World) -> None:
    w.grids[2].insert_scan(w.scan, ORIGIN, pose=w.poses[2])


def _insert_one_twin(twins: list[EvidenceTwin], w: World) -> None:
    twins[2].insert_scan(w.scan, ORIGIN, pose=w.poses[2])


def _insert_many(w: World) -> None:
    update_grids(w.grids, w.poses, w.scan, origin=ORIGIN)


def _insert_many_twins(twins: list[EvidenceTwin], w: World) -> None:
    for twin, pose in zip(twins, w.poses):
        twin.insert_scan(w.scan, ORIGIN, pose=pose)


def _insert_threads(w: World) -> None:
    update_grids(w.grids, w.poses, w.scan, origin=ORIGIN, threads=2)


def _merge(w: World) -> None:
    w.grids[2].merge(w.grids[1], w.poses[2])


def _merge_twin(twins: list[EvidenceTwin], w: World) -> None:
    twins[2].merge(w.twins[1], w.poses[2])


BRICKS = np.array([[0, 0, 0], [-1, 0, 0], [20, 20, 20]])  # with no node but the root in common
VALUES = np.arange(3 * 512, dtype=np.int16).reshape(3, 512)


def _write(w: World) -> None:
    w.grids[2].write_bricks(BRICKS, VALUES)


def _write_twin(twins: list[EvidenceTwin], w: World) -> None:
    twins[2].write_bricks(BRICKS, VALUES)


def _compact(w: World) -> None:
    compact_grids(w.grids)


def _unchanged(twins: list[EvidenceTwin], w: World) -> None:
    pass


ACTIONS: dict[str, tuple[Callable[[World], None], Callable[[list[EvidenceTwin], World], None]]] = {
    "insert": (_insert_one, _insert_one_twin),
    "insert into many": (_insert_many, _insert_many_twins),
    "insert by threads": (_insert_threads, _insert_many_twins),
    "merge": (_merge, _merge_twin),
    "write": (_write, _write_twin),
    "compact": (_compact, _unchanged),
}


def settle(w: World, after: list[EvidenceTwin]) -> int:
    """Every grid is as before or as after, nothing lost in the pool; returns how many are as after."""
    done = 0
    for k, grid in enumerate(w.grids):
        try:
            assert_same(grid, w.twins[k])
        except AssertionError:
            assert_same(grid, after[k])
            w.twins[k] = after[k]
            done += 1
    check_pool(w.pool, w.grids)
    return done


@pytest.mark.parametrize("name", [n for n in ACTIONS if n != "compact"])
def test_when_memory_is_short(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The pool or the scratch cannot grow, at any of the times that they would."""
    action, twin_action = ACTIONS[name]
    failed = 0
    for at in range(40):
        w = World()
        _shrink(w.pool)
        after = [t.copy() for t in w.twins]
        twin_action(after, w)
        left = [at]
        lock = threading.Lock()

        def counted(real: Callable[..., Any]) -> Callable[..., Any]:
            def allocate(*arguments: Any, **more: Any) -> Any:
                with lock:  # noqa: B023
                    left[0] -= 1  # noqa: B023
                    if left[0] < 0:  # noqa: B023
                        raise MemoryError("no room")
                return real(*arguments, **more)

            return allocate

        with monkeypatch.context() as patch:
            patch.setattr(pool_module, "aligned_empty", counted(pool_module.aligned_empty))
            patch.setattr(scratch_module.Scratch, "resize", counted(scratch_module.Scratch.resize))
            went_through = False
            try:
                action(w)
            except MemoryError:
                failed += 1
            else:
                went_through = True
        if went_through:
            w.twins = after
            w.check()
            break
        settle(w, after)
        w.insert(2, w.scan)  # with memory back, the pool is of use
        w.check()
    else:
        pytest.fail("never went through")
    assert failed >= 2


def _shrink(pool: GridPool, spare: int = 0) -> None:
    """Leave a pool room for no more than ``spare`` nodes and bricks and what lies on its stacks."""
    tree = pool.tree
    nodes, bricks = int(tree.counters[0]) + spare, int(tree.counters[2]) + spare
    shorter = {name: getattr(tree, name)[:nodes].copy() for name in OF_NODES}
    shorter |= {name: getattr(tree, name)[:bricks].copy() for name in OF_BRICKS}
    pool.tree = tree._replace(**shorter)


@pytest.mark.parametrize("spare", range(9))
@pytest.mark.parametrize("name", [n for n in ACTIONS if n != "compact"])
def test_room_is_reserved_for_every_node_taken(name: str, spare: int) -> None:
    """Whatever is left of the pool's capacity, nothing is taken that was not reserved."""
    action, twin_action = ACTIONS[name]
    w = World()
    w.grids[2], w.twins[2] = w.grids[2].empty(), w.twins[2].empty()  # so that roots are taken too
    after = [t.copy() for t in w.twins]
    twin_action(after, w)
    w.pool.collect()
    _shrink(w.pool, spare)
    action(w)
    w.twins = after
    w.check()


@pytest.mark.skipif(sys.gettrace() is not None, reason="a debugger or a coverage tool is tracing")
@pytest.mark.parametrize("name", list(ACTIONS))
def test_ctrl_c_at_every_line(name: str) -> None:
    """A signal at each line of the library in turn: it is heard, and each grid is as before or as after."""
    action, twin_action = ACTIONS[name]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    folder = str(Path(graphslam.evidence.__file__).parent)
    after = None
    heard = finished = 0
    for at in range(1, 1000):
        w = World()
        if after is None:
            after = [t.copy() for t in w.twins]
            twin_action(after, w)
        left = [at]

        def lines(frame: Any, event: str, argument: Any) -> Any:
            if event == "line":
                left[0] -= 1  # noqa: B023
                if left[0] == 0:  # noqa: B023
                    sys.settrace(None)
                    signal.raise_signal(signal.SIGINT)
            return lines

        def calls(frame: Any, event: str, argument: Any) -> Any:
            code = frame.f_code
            # in a finaliser Python itself drops the exception
            return lines if code.co_filename.startswith(folder) and code.co_name != "__del__" else None

        try:
            sys.settrace(calls)
            try:
                action(w)
            finally:
                sys.settrace(None)
        except KeyboardInterrupt:
            heard += 1
        finished += settle(w, after) > 0
        if left[0] > 0:
            break  # it ended before its turn came
    assert heard == at - 1 > 20  # every one was heard, also where it was put off
    assert name == "compact" or finished > 0
