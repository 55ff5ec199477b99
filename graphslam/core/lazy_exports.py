"""The face of a room: names that the package of a room offers, each looked up in its module when it is first used.

A face lists what is documented and may be imported by notebooks and programs of others: ``from graphslam.plots import
plot_scan``. Which module holds a name may change; importing a face costs nothing heavy.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def lazy_exports(
    room: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """What a room's ``__init__`` binds to ``__getattr__``, ``__dir__`` and ``__all__``.

    Parameters
    ----------
    room : str
        Name of the package.
    modules : mapping of str to str
        Module, relative to the room → the names of it that are offered, separated by spaces. No name may be that of a
        module or package of the room: importing that would take its place.

    Returns
    -------
    __all__ : list of str
        Sorted.
    """
    home = {name: f"{room}.{module}" for module, names in modules.items() for name in names.split()}

    def getattr_(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        return getattr(importlib.import_module(home[name]), name)

    return getattr_, lambda: sorted(home), sorted(home)
