"""What a reader is: how a kind of source is recognised and read."""

from __future__ import annotations

import importlib
import inspect
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
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
    says : str
        What it reads, in one line.
    target : str
        ``module:function``; the function takes the path, and options as keyword arguments with annotations. Imported
        when used.
    recognise : callable
        Takes a :class:`~graphslam.io.source_probe.SourceProbe` and gives a
        :class:`~graphslam.io.source_probe.ReaderMatch`, or None where the source is not its. It goes by what files
        hold, and must not raise.
    parts : mapping of str to mapping
        Logs inside one data set, by the name that stands after the card's (``mrclam-dataset7/robot1``), and what the
        function is told for each.
    preset : str
        Name of the preset that fits what it reads, where the log's own name has none.
    """

    says: str
    target: str
    recognise: Callable[[SourceProbe], ReaderMatch | None]
    parts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    preset: str = ""

    def function(self) -> Callable[..., Any]:
        """The function itself."""
        module, _, function = self.target.partition(":")
        return typing.cast(Callable[..., Any], getattr(importlib.import_module(module), function))

    def options(self) -> dict[str, inspect.Parameter]:
        """Options of the function by name, with their defaults and annotations."""
        parameters = list(inspect.signature(self.function()).parameters.values())[1:]
        return {p.name: p for p in parameters if p.name not in _NOT_OPTIONS and p.kind is p.KEYWORD_ONLY}

    def takes_name(self) -> bool:
        """Does the function take ``name``, the name of the log?"""
        return "name" in inspect.signature(self.function()).parameters

    def __call__(self, path: Path, **given: Any) -> Any:
        """Read."""
        function = self.function()
        known, hints = self.options(), typing.get_type_hints(function)
        values = {}
        for key, value in given.items():
            if key == "drops" or (key == "name" and self.takes_name()):
                values[key] = value
            elif key not in known:
                raise ConfigError(f"unknown reader option {key!r}; known: {', '.join(sorted(known)) or 'none'}")
            else:
                values[key] = convert_option(hints.get(key, Any), value, f"reader option {key}")
        return function(path, **values)
