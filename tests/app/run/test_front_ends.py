"""What a log recommends reaches only front ends that know the option; one BLAS thread on the command line."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field
from typing import Any, ClassVar

import pytest

import graphslam as gs
from graphslam.app.run import front_ends
from graphslam.core import plugins
from graphslam.core.errors import UnknownNameError
from graphslam_frontends.base import FrontEnd


@dataclass(frozen=True)
class Plain:
    length: float = 1.0


@dataclass(frozen=True)
class WithoutMotion(FrontEnd):
    config: Plain = field(default_factory=Plain)
    name: ClassVar[str] = "plain"

    def submaps(self, log: Any, **_: Any) -> Any:
        return iter(())


class Entry:
    name = "plain"

    def load(self) -> type:
        return WithoutMotion


def test_a_front_end_without_motion_is_not_given_any(monkeypatch: pytest.MonkeyPatch) -> None:
    log = gs.simulate("landmark-field", preset="quick")
    assert front_ends.recommended_options(log, "rbpf-ekf")["frontend"]["motion"]["speed"] == log.meta["noise"]["speed"]
    monkeypatch.setattr(plugins, "entry_points", lambda group: [Entry()] if group == front_ends.GROUP else [])
    values = front_ends.recommended_options(log, "plain")
    assert values == {}
    assert front_ends.make_front_end("plain", values.get("frontend", {})).config == Plain()
    with pytest.raises(UnknownNameError, match="plain"):
        front_ends.make_front_end("rbpf-ekf", {})


@pytest.mark.parametrize(("before", "after"), [(None, "1"), ("3", "3")])
def test_command_line_uses_one_blas_thread_unless_asked(before: str | None, after: str) -> None:
    code = (
        "import sys, typer, graphslam; assert 'numpy' not in sys.modules\n"
        "import graphslam.app.cli, os; print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    if before is not None:
        environment["OPENBLAS_NUM_THREADS"] = before
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == after
