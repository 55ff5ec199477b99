"""Options of a run as a table: name, type, default and meaning."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
import typing
from collections.abc import Iterator
from typing import Any

from graphslam.app.run.config import RunConfig
from graphslam.app.run.front_ends import config_of
from graphslam.core.config import KEYS

_ENTRY = re.compile(r"^(\w+(?:, \w+)*) : .*\n((?: {4}.*\n?)+)", re.MULTILINE)
"""An entry of a docstring section: names, and the text below them."""


@dataclasses.dataclass(frozen=True, slots=True)
class OptionRow:
    """One option.

    Parameters
    ----------
    option : str
        As in ``--set option=value``.
    type, default, meaning : str
    """

    option: str
    type: str
    default: str
    meaning: str


def option_rows(frontend: str | None = None) -> list[OptionRow]:
    """Options of a front end; without a name those of every run."""
    if frontend is not None:
        return list(_rows(config_of(frontend), "frontend"))
    return [row for row in _rows(RunConfig, "") if row.option != "frontend"]


def _rows(kind: Any, where: str) -> Iterator[OptionRow]:
    hints, meanings = typing.get_type_hints(kind), _meanings(kind)
    for f in dataclasses.fields(kind):
        hint = hints[f.name]
        nested = next((h for h in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(h)), None)
        keys = f.metadata.get(KEYS)
        if nested is None:
            name = ".".join(filter(None, (where, f.name)))
            yield OptionRow(name, str(f.type), _default(f), meanings.get(f.name, ""))
        elif keys is None:
            yield from _rows(nested, ".".join(filter(None, (where, f.name))))
        else:  # a small dataclass whose fields are written as several keys of the enclosing table
            inside = {r.option: r for r in _rows(nested, "")}
            for key, part in keys.items():
                row = inside[part]
                meaning = row.meaning or meanings.get(f.name, "")
                default = repr(getattr(f.default, part))
                yield OptionRow(".".join(filter(None, (where, key))), row.type, default, meaning)


def _default(f: dataclasses.Field[Any]) -> str:
    if f.default is not dataclasses.MISSING:
        return repr(f.default)
    return repr(f.default_factory()) if f.default_factory is not dataclasses.MISSING else "none: required"


def _meanings(kind: Any) -> dict[str, str]:
    """Meaning of each field of a dataclass: its attribute docstring, or its entry under ``Parameters``."""
    out: dict[str, str] = {}
    for cls in reversed(kind.__mro__[:-1]):
        for names, text in _ENTRY.findall(inspect.getdoc(cls) or ""):
            out |= dict.fromkeys(names.split(", "), " ".join(text.split()))
        (made,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        for node, text in itertools.pairwise(made.body if isinstance(made, ast.ClassDef) else []):
            match node, text:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(meaning))):
                    out[name] = " ".join(meaning.split())
    return out
