"""Trials that do what workers must survive: they fail, die, hang and give nonsense."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

from graphslam_studies.montecarlo.trials import Measurement


def steady(seed: int) -> list[Measurement]:
    rng = np.random.default_rng(seed)
    return [Measurement("a", "q", float(rng.normal())), Measurement("a", "seconds", time.perf_counter(), timing=True)]


def fails_once(seed: int, *, bad: int) -> list[Measurement]:
    if seed == bad:
        raise ValueError("no convergence")
    return steady(seed)


def dies_once(seed: int, *, bad: int) -> list[Measurement]:
    if seed == bad:
        os.kill(os.getpid(), signal.SIGKILL)
    return steady(seed)


def gives_a_lambda(seed: int) -> list[object]:
    return [lambda: seed]


def notes_its_process(seed: int, *, folder: str, seconds: float = 0.0) -> list[Measurement]:
    (Path(folder) / f"{os.getpid()}-{seed}").touch()
    time.sleep(seconds)
    return [Measurement("a", "blas", _blas_threads())]


def _blas_threads() -> float:
    from threadpoolctl import threadpool_info

    np.ones((2, 2)) @ np.ones((2, 2))
    return float(max(pool["num_threads"] for pool in threadpool_info()))
