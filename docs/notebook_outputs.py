"""The notebooks with their outputs, for the pages of the site: executed once, then read from a cache.

``python docs/notebook_outputs.py`` executes those whose outputs are not in ``build/notebooks``; ``make docs`` calls it.
The name of a file in the cache has a digest of the notebook and of all code that it can call, so a change of either
executes it again. Notebooks run in quick mode, as in the tests.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CACHE = ROOT / "build" / "notebooks"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
TIMEOUT_S = 1800


@cache
def digest_of_code() -> bytes:
    """Of all modules of the package, the front ends and the studies, and of the descriptions of data sets."""
    total = hashlib.sha256()
    for folder, ending in (("graphslam", "*.py"), ("frontends", "*.py"), ("notebooks", "*.py"), ("datasets", "*.toml")):
        for path in sorted((ROOT / folder).rglob(ending)):
            total.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return total.digest()


def cached(path: Path) -> Path:
    """The file with the outputs of a notebook, which may not exist; recorded data change what a notebook shows."""
    data = b"data" if os.environ.get("GRAPHSLAM_DATA") else b""
    total = hashlib.sha256(path.read_bytes() + digest_of_code() + data)
    return CACHE / f"{path.stem}-{total.hexdigest()[:16]}.ipynb"


def execute(path: Path) -> Any:
    """A notebook with its outputs; after a cell that fails no other is run."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    book = nbformat.read(path, as_version=4)
    with TemporaryDirectory() as where:
        env = {
            **os.environ,
            "GRAPHSLAM_QUICK": "1",
            "GRAPHSLAM_CACHE": str(Path(where) / "cache"),
            "MPLBACKEND": "module://matplotlib_inline.backend_inline",
        }
        resources = {"metadata": {"path": where}}
        client = NotebookClient(book, timeout=TIMEOUT_S, kernel_name="python3", resources=resources)
        try:
            client.execute(env=env)
        except CellExecutionError as error:
            # without its recorded data a notebook ends with one sentence; any other error is one of the notebook
            if error.ename != "NotebookStop":
                raise
    return book


def main() -> None:
    """Execute those that are not in the cache; old files of the same notebooks are removed."""
    import nbformat

    CACHE.mkdir(parents=True, exist_ok=True)
    for path in NOTEBOOKS:
        target, begin = cached(path), time.perf_counter()
        if target.exists():
            continue
        part = target.with_suffix(".part")
        nbformat.write(execute(path), part)
        for old in CACHE.glob(f"{path.stem}-*.ipynb"):
            old.unlink()
        part.rename(target)
        print(f"executed {path.name} ({time.perf_counter() - begin:.0f} s)", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
