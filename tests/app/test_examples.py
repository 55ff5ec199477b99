"""The examples of the public names run, and give what they say."""

from __future__ import annotations

import doctest
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import graphslam as gs

TYPES = {"Collapse", "FactorGraph", "Run", "SensorLog", "SkeletonProblem", "Slam", "Submap", "Trajectory"}
NAMES = sorted(n for n in gs.__all__ if n not in ("__version__", "plots"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Any]]:
    """What the examples take for granted: ``gs``, ``np``, a log, a run of it, and their folders."""
    from graphslam.app.worlds import write_simulated

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("examples"))
        log = gs.simulate("landmark-field", preset="quick", seed=1)
        write_simulated(log, Path("logs/field"))
        run = gs.run(log, out="runs/field", progress=False)
        gs.run(gs.simulate("landmark-field", preset="quick", seed=2), out="runs/second", progress=False)
        yield {"gs": gs, "np": np, "log": log, "run": run}


@pytest.mark.parametrize("name", NAMES)
def test_example_of_a_public_name_runs(name: str, folder: dict[str, Any]) -> None:
    if name == "to_open3d" and find_spec("open3d") is None:
        pytest.skip("the extra open3d is not installed")
    thing = getattr(gs, name)
    finder = doctest.DocTestFinder(recurse=False)
    (found,) = finder.find(thing, name, globs=dict(folder))
    assert found.examples, f"{name} has no example"
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    failures: list[str] = []
    doctest.DocTestRunner(optionflags=flags, verbose=False).run(found, out=failures.append)
    assert not failures, "".join(failures)


@pytest.mark.parametrize("name", sorted(set(NAMES) - TYPES))
def test_a_verb_says_what_comes_out_and_what_goes_wrong(name: str) -> None:
    """Types say it of their fields; lists of names cannot fail."""
    doc = getattr(gs, name).__doc__ or ""
    if isinstance(getattr(gs, name), type):
        return
    if name not in ("front_ends", "joiners", "solvers", "worlds"):
        assert "Returns\n    -------" in doc
        assert "Raises\n    ------" in doc
