"""Interface of readers: how a kind of source is recognised and read."""

from __future__ import annotations

import importlib
import inspect
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from graphslam.core.config import convert_option
from graphslam.core.errors import ConfigError
from graphslam.io.source_probe import ReaderMatch, SourceProbe

_NOT_OPTIONS = ("name", "drops")


@dataclass(frozen=True, slots=True)
class Reader:
    """How a kind of source is recognised and read.

    Parameters
    ----------
    reads : str
        Description of its sources, in one line.
    target : str
        ``module:function``; the function takes the path, and options as keyword arguments with annotations. Imported
        on use.
    recognise : callable
        Takes a :class:`~graphslam.io.source_probe.SourceProbe` and returns a
        :class:`~graphslam.io.source_probe.ReaderMatch`, or None if the reader cannot read the source. It uses the
        content of files, and must not raise.
    parts : mapping of str to mapping
        Logs in one data set, by the name after that of the data set (``mrclam-dataset7/robot1``), with the options of
        the function for each.
    preset : str
        Name of the default preset for its sources, if there is none for the name of the log.
    """

    reads: str
    target: str
    recognise: Callable[[SourceProbe], ReaderMatch | None]
    parts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    preset: str = ""

    def function(self) -> Callable[..., Any]:
        """Import and return the function."""
        module, _, function = self.target.partition(":")
        return typing.cast(Callable[..., Any], getattr(importlib.import_module(module), function))

    def options(self) -> dict[str, inspect.Parameter]:
        """Options by name, with defaults and annotations: keyword-only arguments; for a dataclass, its fields."""
        function = self.function()
        hints, out = typing.get_type_hints(function), dict[str, inspect.Parameter]()
        for p in list(inspect.signature(function).parameters.values())[1:]:
            if p.name in _NOT_OPTIONS or p.kind is not p.KEYWORD_ONLY:
                continue
            if not is_dataclass(hints.get(p.name)):
                out[p.name] = p
                continue
            for f in fields(p.default):
                value = getattr(p.default, f.name)
                out[f.name] = inspect.Parameter(f.name, p.KEYWORD_ONLY, default=value, annotation=f.type)
        return out

    def takes_name(self) -> bool:
        """Does the function take ``name``, the name of the log?"""
        return "name" in inspect.signature(self.function()).parameters

    def __call__(self, path: Path, **given: Any) -> Any:
        """Read a source with the given options; :class:`ConfigError` for an unknown option."""
        function = self.function()
        known, hints = self.options(), typing.get_type_hints(function)
        if unknown := sorted(set(given) - set(known) - ({"name"} if self.takes_name() else set())):
            raise ConfigError(f"unknown reader option {unknown[0]!r}; known: {', '.join(sorted(known)) or 'none'}")
        values = {}
        for name, p in inspect.signature(function).parameters.items():
            hint = hints.get(name, Any)
            if p.kind is p.KEYWORD_ONLY and is_dataclass(hint):
                types = typing.get_type_hints(hint)
                part = {k: _convert(types[k], given[k], k) for k in types if k in given}
                values[name] = replace(p.default, **part)
            elif name in given:
                values[name] = _convert(hint, given[name], name)
        return function(path, **values)


def _convert(hint: Any, value: Any, name: str) -> Any:
    return convert_option(hint, value, f"reader option {name}")
