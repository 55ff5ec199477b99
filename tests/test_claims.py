"""The page of the papers' claims: its commands can be started, its options exist with the defaults that it names."""

from __future__ import annotations

import dataclasses
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

import graphslam as gs
from graphslam.app.cli import app
from graphslam.app.option_table import option_rows
from graphslam.app.run.front_ends import make_front_end
from graphslam.core.config import merge_options, parse_setting
from graphslam.maps.surface.piece import SurfaceConfig
from graphslam.skeleton.relax import RelaxConfig

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "notes" / "claims.md").read_text(encoding="utf-8")
CLAIMS, DEPARTURES = PAGE.split("## Departures from the papers' equations\n")
PAPERS = re.findall(r"^## (.+?) \(.*?\n(.*?)(?=^## |\Z)", CLAIMS, re.M | re.S)
"""Name of each paper, and its part of the page."""
VERDICTS = {"**yes**", "**no**", "**not always**", "**not tested**"}


def rows(text: str, columns: int) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    assert all(len(c) == columns for c in cells), [c for c in cells if len(c) != columns]
    return [c for c in cells if not set("".join(c)) <= set("-") and c[0] not in ("Claim", "Equation")]


def commands(text: str) -> dict[str, str]:
    return dict(re.findall(r"^\* ([\w-]+): `(.+)`$", text, re.M))


def test_each_claim_has_a_verdict_and_each_verdict_a_command() -> None:
    assert [name for name, _ in PAPERS] == ["SegSLAM", "Combined SLAM", "Urban GraphSLAM"]
    for _, text in PAPERS:
        known, used = commands(text), set()
        for claim, where, verdict, value, command, page in rows(text, 6):
            assert where, claim
            assert value, claim
            assert verdict in VERDICTS, claim
            if re.fullmatch(r"`tests/.+`", command):
                file, test = command.strip("`").split("::")
                assert f"def {test}(" in (ROOT / file).read_text(encoding="utf-8"), claim
            elif command != "–":
                assert set(command.split(", ")) <= set(known), claim
                used |= set(command.split(", "))
            else:
                assert verdict == "**not tested**" or (verdict == "**no**" and page != "–"), claim
        assert used == set(known)


@pytest.mark.parametrize("line", [c for _, text in PAPERS for c in commands(text).values()])
def test_command_can_be_started(line: str) -> None:
    program, *words = shlex.split(line)
    if program == "python":
        assert words[0] == "-m"
        source = (ROOT / (words[1].replace(".", "/") + ".py")).read_text(encoding="utf-8")
        assert all(f'"{w}"' in source for w in words[2:] if w.startswith("--"))
        return
    assert program == "graphslam"
    command = typer.main.get_command(app)
    parsed: Any = command.get_command(typer.Context(command), words[0]).make_context(words[0], words[1:])  # type: ignore[attr-defined]
    if words[0] == "study":
        there = gs.find_study(parsed.params["name"]).worlds(False)
        assert set(filter(None, (parsed.params["worlds"] or "").split(","))) <= set(there)


@pytest.mark.parametrize("front_end", ["segslam", "rbpf-ekf"])
def test_literal_options_of_a_run_exist_with_their_defaults(front_end: str) -> None:
    (text,) = re.findall(rf"^### .*`{front_end}`\n(.*?)(?=^### )", DEPARTURES, re.M | re.S)
    known = {r.option: r.default for r in [*option_rows(front_end), *option_rows()]}
    options: dict[str, Any] = {}
    count = 0
    for name, literal, default in settings(text):
        assert known[name].strip("'") == default, name
        if name.startswith("frontend."):
            options = merge_options(options, parse_setting(f"{name}={literal}"))
        count += 1
    assert count >= 9
    make_front_end(front_end, options.get("frontend", {}))


def test_literal_options_of_python_exist_with_their_defaults() -> None:
    text = DEPARTURES.split("### Urban GraphSLAM")[1]
    kinds = {"RelaxConfig": RelaxConfig, "SurfaceConfig": SurfaceConfig}
    found = settings(text)
    assert len(found) >= 5
    for name, literal, default in found:
        kind, field = name.split(".")
        assert str(getattr(kinds[kind](), field)) == default, name
        dataclasses.replace(kinds[kind](), **{field: False if literal == "False" else literal})


def settings(text: str) -> list[tuple[str, str, str]]:
    """Option, literal value and default of each."""
    out = []
    for equation, *_, literal, default in rows(text, 6):
        names, defaults = re.findall(r"`([^`=]+)=([^`]+)`", literal), re.findall(r"`([^`]+)`", default)
        assert len(names) == len(defaults), equation
        out += [(name, value, d) for (name, value), d in zip(names, defaults)]
    return out
