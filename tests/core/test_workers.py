"""Tasks on several threads."""

from __future__ import annotations

import threading

import pytest

from graphslam.core.workers import cores, run_tasks


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_keep_the_order_of_the_items(threads):
    assert run_tasks(lambda k, m: k * m, ((k, 2) for k in range(50)), threads) == [2 * k for k in range(50)]


def test_tasks_run_at_the_same_time():
    barrier = threading.Barrier(2, timeout=30.0)  # one thread alone would not pass it
    assert sorted(run_tasks(lambda _: barrier.wait(), ((k,) for k in range(2)), 2)) == [0, 1]


def test_items_are_read_only_a_few_ahead_of_the_work():
    first, read = threading.Event(), []

    def items():
        for k in range(100):
            read.append(k)
            if k == 4:  # the first task has not ended
                first.set()
            yield (k,)

    def work(k):
        if k == 0:
            first.wait(30.0)
            assert len(read) < 7
        return k

    assert run_tasks(work, items(), 2) == list(range(100))


def test_an_error_of_a_task_is_raised():
    def fail(k):
        raise ValueError(k)

    with pytest.raises(ValueError, match="0"):
        run_tasks(fail, ((k,) for k in range(3)), 2)
    assert cores() >= 1
