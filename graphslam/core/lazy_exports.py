"""Public names of a package, imported lazily from their modules at first use.

They are documented and can be imported by notebooks and other programs: ``from graphslam.plots import plot_scan``. The
module of a name can change. Importing the package is cheap.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def lazy_exports(
    room: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Values for ``__getattr__``, ``__dir__`` and ``__all__`` of a package's ``__init__``.

    Parameters
    ----------
    room : str
        Name of the package.
    modules : mapping of str to str
        Module, relative to the package → its public names, separated by spaces. No name may equal that of a module of
        the package, whose import would replace it.

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
