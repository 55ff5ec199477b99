"""Run the notebooks in full mode and keep what they show: ``python -m tests.notebooks_in_full OUT [01 04 …]``.

Writes the pictures and the printed text of every notebook to ``OUT/NAME/``, to be looked at, and how long each took.
All together take less than half an hour on two cores that nobody else uses.
"""

from __future__ import annotations

import argparse
import base64
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from nbclient.exceptions import CellExecutionError

from tests.test_notebooks import NOTEBOOKS, execute


def main() -> int:
    """Run them; 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("numbers", nargs="*", help="such as 01 04; all where none is given")
    asked = parser.parse_args()
    failed, begin = 0, time.perf_counter()
    for path in NOTEBOOKS:
        if asked.numbers and path.stem[:2] not in asked.numbers:
            continue
        started, error = time.perf_counter(), ""
        with TemporaryDirectory() as where:
            try:
                book = execute(path, Path(where), GRAPHSLAM_QUICK="0", GRAPHSLAM_CACHE="")
            except CellExecutionError as found:
                book, error = found.book, str(found)  # type: ignore[attr-defined]
                failed += 1
        folder = asked.out / path.stem
        folder.mkdir(parents=True, exist_ok=True)
        texts = [error] if error else []
        for cell in (c for c in book.cells if c.cell_type == "code"):
            for k, output in enumerate(cell.get("outputs", ())):
                data = output.get("data", {})
                texts.append(f"--- {cell.id}\n{output.get('text', '') or data.get('text/plain', '')}")
                if "image/png" in data:
                    (folder / f"{cell.id}-{k}.png").write_bytes(base64.b64decode(data["image/png"]))
        (folder / "said.txt").write_text("\n".join(texts), encoding="utf-8")
        print(f"{path.stem:30} {time.perf_counter() - started:6.0f} s {'FAILED' if error else ''}", flush=True)
    print(f"all: {(time.perf_counter() - begin) / 60:.1f} min")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
