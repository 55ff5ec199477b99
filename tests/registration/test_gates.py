"""Gates of a match: each keeps out what is beyond it, alone, and names itself."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from graphslam.core import se3
from graphslam.core.errors import ConfigError
from graphslam.registration.config import RegistrationConfig, RegistrationGates
from graphslam.registration.gates import (
    MatchGates,
    failed_match_gates,
    height_between,
    match_margins,
    shift_between,
    tilt_between,
)
from graphslam.registration.register import Registration

HERE = np.array([0.0, 0, 0, 0, 0, 0, 1])
RULES = RegistrationConfig(gates=RegistrationGates(fitness=0.5))


def found(x: float = 0.0, z: float = 0.0, **rest: object) -> Registration:
    known = {
        "T_target_source": np.array([x, 0.0, z, 0, 0, 0, 1]),
        "covariance": np.diag([1e-6] * 3 + [1e-4] * 3),
        "fitness": 0.9,
        "fitness_upright": 0.9,
        "degeneracy": 0.05,
        "converged": True,
        "why": "",
        "inliers": 100,
    }
    nothing = dict.fromkeys((f.name for f in dataclasses.fields(Registration)), math.nan)
    return Registration(**{**nothing, **known, **rest})  # type: ignore[arg-type]


def leaning(degrees: float) -> np.ndarray:
    return np.concatenate([np.zeros(3), se3.so3_exp([math.radians(degrees), 0, 0])])


@pytest.mark.parametrize(
    ("beyond", "within", "name"),
    [
        ({"fitness": 0.82}, {"fitness": 0.84}, "fitness"),
        ({"fitness_upright": 0.79}, {"fitness_upright": 0.81}, "fitness of upright surfaces"),
        ({"z": 1.61}, {"z": 1.59}, "height"),
        ({"x": 5.01}, {"x": 4.99}, "shift"),
        ({"T_target_source": leaning(4.1)}, {"T_target_source": leaning(3.9)}, "tilt"),
        (
            {"covariance": np.diag([1e-6] * 3 + [0.17, 1e-4, 1e-4])},
            {"covariance": np.diag([1e-6] * 3 + [0.15, 1e-4, 1e-4])},
            "vague",
        ),
        (
            {"covariance": np.diag([1e-6, 1e-6, 0.0017] + [1e-4] * 3)},
            {"covariance": np.diag([1e-6, 1e-6, 0.0015] + [1e-4] * 3)},
            "vague",
        ),
        ({"degeneracy": 0.0029}, {"degeneracy": 0.0031}, "degenerate"),
        ({"converged": False, "why": "too few; too far"}, {"converged": True}, "nothing"),
    ],
)
def test_each_gate_keeps_out_what_is_beyond_it(beyond: dict, within: dict, name: str) -> None:  # type: ignore[type-arg]
    def fails(**change: object) -> list[str]:
        return failed_match_gates(found(**change), HERE, MatchGates(), RULES, sigma=2.0, margin=1.0)

    assert [f.startswith(name) for f in fails(**beyond)] == [True]
    assert fails(**within) == []


def test_margin_rise_and_a_shift_that_is_not_asked() -> None:
    gates = MatchGates(shift=math.inf)
    assert failed_match_gates(found(x=100.0), HERE, gates, RULES, sigma=1.0, margin=1.0) == []
    assert failed_match_gates(found(), HERE, gates, RULES, sigma=1.0, margin=0.09) == ["margin 0.090 < 0.1"]
    assert failed_match_gates(found(z=2.5), HERE, gates, RULES, sigma=1.0, margin=1.0, rise=1.0) == []
    assert len(failed_match_gates(found(z=2.7), HERE, gates, RULES, sigma=1.0, margin=1.0, rise=1.0)) == 1
    vague = found(covariance=np.eye(6))
    assert failed_match_gates(vague, HERE, gates, RULES, sigma=1.0, margin=1.0, ask_vague=False) == []


def test_second_modes_are_those_of_the_same_map_at_another_place() -> None:
    results = [found(0.0, fitness=0.95), found(1.4, fitness=0.94), found(8.0, fitness=0.9), found(8.0, fitness=0.99)]
    maps = [0, 0, 0, 1]

    def plain(k: int) -> float:
        """One by one."""
        others = [
            r.fitness
            for r, m in zip(results, maps)
            if m == maps[k] and np.linalg.norm((r.T_target_source - results[k].T_target_source)[:3]) >= 1.5
        ]
        return results[k].fitness - max(others) if others else 1.0

    np.testing.assert_allclose(match_margins(results, maps, 1.5), [plain(k) for k in range(4)])
    failed = [results[0], found(8.0, fitness=0.9, converged=False)]
    assert match_margins(failed, [0, 0], 1.5).tolist() == [1.0, 1.0]
    assert match_margins(results[:1], [0], 1.5).tolist() == [1.0]


def test_distances_between_a_match_and_its_prediction() -> None:
    a, b = np.array([3.0, 4.0, 1.0, 0, 0, 0, 1]), HERE
    assert shift_between(a, b) == 5.0
    assert height_between(a, b) == 1.0
    assert tilt_between(leaning(7.0), b) == pytest.approx(math.radians(7.0))
    assert (height_between([3.0, 4, 1], [0.0, 0, 0]), tilt_between([0.0, 0, 1], [0.0, 0, 0])) == (0.0, 0.0)
    with pytest.raises(ConfigError):
        MatchGates(margin=1.5)
    with pytest.raises(ConfigError):
        MatchGates(height=math.nan)
