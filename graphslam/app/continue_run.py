"""A new session in the graph of saved runs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graphslam.app.merge import merge
from graphslam.app.run import Run


def continue_runs(saved: Sequence[Run | str | Path], run: Run, *, out: str | Path | None = None) -> Any:
    """Put a new run into the graph of saved ones, tied where it was localised in them; the first one's base is fixed.

    Written again if it was there before: the run itself may have been resumed.

    Raises
    ------
    DataError
        It is not found in any of them. The run itself stays as it is.
    """
    if out is not None and (Path(out) / "merge.json").is_file():
        shutil.rmtree(out)
    return merge([*saved, run], out=out)
