"""Kinds of sensors whose readings a graph turns into factors, one file each; every file of this folder is found.

A kind is a subclass of :class:`~graphslam.graph.sensors.base.SensorFactors`. A new sensor needs only this class, its
record (``graphslam.core``) and its factors (:mod:`graphslam.graph.factors`).
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from graphslam.core.errors import DataError
from graphslam.graph.sensors.base import SensorFactors


@cache
def sensor_kinds() -> dict[str, type[SensorFactors]]:
    """Kinds of sensors by name."""
    for module in iter_modules(__path__):
        import_module(f"{__name__}.{module.name}")
    return {kind.name: kind for kind in sorted(SensorFactors.kinds, key=lambda kind: kind.name)}


def kind_of(readings: Any) -> type[SensorFactors]:
    """The kind of sensor of these readings."""
    for kind in sensor_kinds().values():
        if isinstance(readings, kind.readings):
            return kind
    known = ", ".join(k.readings.__name__ for k in sensor_kinds().values())
    raise DataError("no sensor of a graph has such readings", got=type(readings).__name__, wanted=known)
