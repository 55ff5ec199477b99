"""The face of a room: documented names, looked up when they are used."""

from __future__ import annotations

import importlib
import inspect
import json
import pkgutil
import re
from pathlib import Path

import pytest

import graphslam
from graphslam.core.lazy_exports import lazy_exports

ROOT = Path(__file__).resolve().parents[2]
ROOMS = sorted(
    m.name
    for m in pkgutil.iter_modules(graphslam.__path__)
    if m.ispkg and hasattr(importlib.import_module(f"graphslam.{m.name}"), "_EXPORTS")
)
every_room = pytest.mark.parametrize("room", ROOMS)


def shown() -> str:
    """All notebooks and pages."""
    cells = [c for p in ROOT.glob("notebooks/*.ipynb") for c in json.loads(p.read_text(encoding="utf-8"))["cells"]]
    text = ["".join(c["source"]) for c in cells]
    return "\n".join(text + [p.read_text(encoding="utf-8") for p in ROOT.glob("docs/**/*.md")])


@every_room
def test_every_name_of_a_face_is_there_and_says_what_it_is(room: str) -> None:
    module = importlib.import_module(f"graphslam.{room}")
    modules = {m.name for m in pkgutil.iter_modules(module.__path__)}
    for name in module.__all__:
        thing = getattr(module, name)
        assert name not in modules, f"{room}.{name} is a module, too: importing it would take the name's place"
        if callable(thing):
            doc = inspect.getdoc(thing) or ""
            assert re.match(r"\S.*[.:]", doc), f"{room}.{name} has no docstring"
    assert set(module.__all__) <= set(dir(module))


def test_what_a_face_offers_is_shown_somewhere() -> None:
    text = shown()
    alone = [
        f"{room}.{name}"
        for room in ROOMS
        for name in importlib.import_module(f"graphslam.{room}").__all__
        if not re.search(rf"\b{name}\b", text)
    ]
    assert not alone, f"in no notebook and on no page: {alone}"


def test_a_face_knows_its_names_only() -> None:
    get, names, listed = lazy_exports("graphslam.core", {"gaussian": "chi2_quantile", "geometry": "wrap_angle"})
    assert names() == listed == ["chi2_quantile", "wrap_angle"]
    assert get("wrap_angle") is importlib.import_module("graphslam.core.geometry").wrap_angle
    with pytest.raises(AttributeError, match="no attribute 'rotation2'"):
        get("rotation2")
