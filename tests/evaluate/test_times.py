"""How fast a run was: compilation and what was there already are no part of it."""

from __future__ import annotations

import numpy as np

from graphslam.evaluate.metrics import Metrics, time_metrics


def values(seconds: dict[str, float], duration: float) -> dict[str, float]:
    out = Metrics()
    time_metrics(out, seconds, duration, 0.0, np.zeros(0))
    return {r["key"]: r["value"] for r in out.rows}


def test_compilation_is_no_part_of_the_speed() -> None:
    found = values({"compilation": 40.0, "total": 60.0}, 100.0)
    assert found == {"seconds_compilation": 40.0, "seconds_total": 60.0, "times_real_time": 5.0}


def test_a_run_that_computed_nothing_has_no_speed() -> None:
    assert "times_real_time" not in values({"compilation": 0.0, "total": 0.6}, 0.0)
