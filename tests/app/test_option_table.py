"""The table of options: every option of every front end is there with its default and a meaning, and can be set."""

from __future__ import annotations

import ast
import json

import pytest
from typer.testing import CliRunner

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.option_table import option_rows
from graphslam.app.run.config import RunConfig
from graphslam.app.run.front_ends import config_of
from graphslam.core.config import build_config


@pytest.mark.parametrize("name", [None, *gs.front_ends()])
def test_every_option_has_a_meaning_and_can_be_set_to_its_default(name: str | None) -> None:
    rows = option_rows(name)
    assert len({r.option for r in rows}) == len(rows)
    assert [r.option for r in rows if not r.meaning] == []
    required = {r.option.rpartition(".")[0] for r in rows if r.default.startswith("none: required")}
    for row in rows:
        if row.option.rpartition(".")[0] in required:  # of a part that is left out by default
            continue
        try:
            default = ast.literal_eval(row.default)
        except (ValueError, SyntaxError):  # inf, a function
            continue
        keys = row.option.split(".")[(0 if name is None else 1) :]
        values = default
        for key in reversed(keys):
            values = {key: list(values) if isinstance(values, tuple) else values}
        if default is not None:
            build_config(RunConfig if name is None else config_of(name), values)


def test_command(tmp_path) -> None:
    shown = CliRunner().invoke(app, ["options", "rbpf-ekf", "--json"])
    rows = {r["option"]: r for r in json.loads(shown.stdout)["options"]}
    assert rows["frontend.particles"]["default"] == "40"
    assert "frontend.particles = 40" in CliRunner().invoke(app, ["options", "rbpf-ekf"]).stdout
    unknown = CliRunner().invoke(app, ["options", "nothing"])
    assert unknown.exit_code == 1
