"""One mutant: import the changed text in place of a module, and run tests until the first fails."""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import os
import sys
from collections.abc import Sequence
from pathlib import Path

UNUSED = 77
"""Exit code: the tests passed, but never imported the changed module."""


class _Swap(importlib.abc.MetaPathFinder):
    """Finds one module in another file. Numba's caches go by the file, so that a mutant never runs cached code."""

    def __init__(self, module: str, file: Path) -> None:
        self.module, self.file = module, file

    def find_spec(self, name: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_file_location(name, self.file) if name == self.module else None


def run(module: str, file: Path, tests: Sequence[str], output: Path) -> None:
    """Run the tests with ``file`` as ``module``; the exit code of the process is pytest's, or `UNUSED`."""
    import pytest

    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # seconds of imports
    os.setsid()  # so that whatever the tests start can be ended with them
    with output.open("wb") as out:
        os.dup2(out.fileno(), 1)
        os.dup2(out.fileno(), 2)
    os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = str(file.parent / "hypothesis")
    sys.meta_path.insert(0, _Swap(module, file))
    options = ["-x", "-q", "--tb=line", "-p", "no:cacheprovider", "-p", "_hypothesis_pytestplugin"]
    options += ["--hypothesis-seed=0", "--import-mode=importlib"]
    code = int(pytest.main([*options, *tests]))
    loaded = getattr(sys.modules.get(module), "__file__", None)
    if code == 0 and loaded != str(file):
        code = UNUSED
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
