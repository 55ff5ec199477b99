"""The progress bar of a run."""

from __future__ import annotations

import re

import pytest

from graphslam.app.run.run_bar import STAGES, RunBar


def lines(text: str) -> list[str]:
    return [line for line in text.split("\r") if "%" in line]


def test_the_bar_shows_every_stage_and_never_goes_back(capsys: pytest.CaptureFixture[str]) -> None:
    with RunBar(True) as bar:
        bar._bar.delay = 0.0
        for name in STAGES:
            bar.stage(name)
    shown = lines(capsys.readouterr().err)
    for i, name in enumerate(STAGES):
        assert any(f"{i + 1}/{len(STAGES)} {name}" in line for line in shown), name
    percent = [int(n) for n in re.findall(r"(\d+) %", " ".join(shown))]
    assert percent == sorted(percent)
    assert percent[-1] == round(100 - STAGES["figures"])


def test_a_short_run_into_a_file_shows_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    with RunBar(True) as bar:
        assert bar._bar.delay == 5.0
        bar.stage("reading")
    assert not lines(capsys.readouterr().err)
