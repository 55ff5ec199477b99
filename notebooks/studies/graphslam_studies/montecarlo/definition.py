"""What a Monte-Carlo study must say of itself, and how one is found by name."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import re
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import pandas as pd

from graphslam.core.errors import ConfigError
from graphslam.core.plugins import load_plugin, plugins, unknown
from graphslam_studies.montecarlo.trials import Measurement


@runtime_checkable
class StudyDefinition(Protocol):
    """A study: its worlds, one trial of each as a function of a seed, and what is made of the table."""

    name: str
    description: str

    def worlds(self, quick: bool) -> tuple[str, ...]:
        """Names of the worlds, in the order in which they are reported."""
        ...

    def default_trials(self, quick: bool) -> int:
        """Trials of each world where none are asked for."""
        ...

    def trial(self, world: str, quick: bool) -> Callable[[int], Iterable[Measurement]]:
        """Trial of one world as a function of its seed: a function of a module, or a ``partial`` of one.

        It runs in other processes and on other machines, so it must be picklable by name, and its figures (not its
        timings) must depend on the seed alone.
        """
        ...

    def report(self, table: pd.DataFrame, timings: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """Named summary tables."""
        ...

    def figures(self, table: pd.DataFrame, timings: pd.DataFrame, folder: Path) -> list[Path]:
        """Draw the study's figures into ``folder``; their paths."""
        ...


GROUP = "graphslam.studies"


def find_study(name: str) -> StudyDefinition:
    """See :func:`graphslam.find_study`."""
    if name in plugins(GROUP):
        found = load_plugin(GROUP, "study", name)
    elif re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", name):
        module, _, attribute = name.partition(":")
        try:
            found = getattr(importlib.import_module(module), attribute)
        except (ModuleNotFoundError, AttributeError) as error:
            raise ConfigError(f"study {name!r} cannot be loaded: {error}") from None
    else:
        raise unknown(GROUP, "study", name, plugins(GROUP))
    if not isinstance(found, StudyDefinition):
        raise ConfigError(f"{name} is no study: it lacks worlds, default_trials, trial, report or figures")
    return cast(StudyDefinition, found)


def fingerprint(trial: Callable[..., Any]) -> str:
    """Short digest of a trial's function and every figure bound to it: the same digest, the same configuration."""
    return hashlib.sha256(_described(trial).encode()).hexdigest()[:16]


def source_digest() -> str:
    """Short digest of the installed code of graphslam, its front ends and the studies.

    Versions change with a release; between releases this tells whether two trials were run by the same code.
    """
    digest = hashlib.sha256()
    for package in ("graphslam", "graphslam_frontends", "graphslam_studies"):
        root = Path(str(importlib.import_module(package).__file__)).resolve().parent
        for path in sorted(root.rglob("*.py")):
            digest.update(f"{package}/{path.relative_to(root).as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _described(value: Any) -> str:
    """A value as text that is the same in every process: no addresses, no order of sets, arrays in full."""
    if isinstance(value, partial):
        return f"partial({_described(value.func)}, {_described(value.args)}, {_described(value.keywords)})"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return f"{type(value).__qualname__}({_described(fields)})"
    if isinstance(value, Mapping):
        return "{" + ", ".join(sorted(f"{_described(k)}: {_described(v)}" for k, v in value.items())) + "}"
    if isinstance(value, (set, frozenset)):
        return "{" + ", ".join(sorted(_described(v) for v in value)) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_described(v) for v in value) + "]"
    if isinstance(value, np.ndarray):
        return f"array({value.dtype}, {value.shape}, {hashlib.sha256(value.tobytes()).hexdigest()})"
    if callable(value) and hasattr(value, "__qualname__"):
        return f"{value.__module__}.{value.__qualname__}"
    if isinstance(value, np.generic):
        return repr(value.item())
    if value is None or isinstance(value, (bool, int, float, str, Path)):
        return repr(value)
    raise ConfigError(
        f"a trial is bound to a {type(value).__qualname__}, which has no fingerprint; "
        "bind numbers, text, arrays, collections and dataclasses of them"
    )
