"""A new session in the graph of saved runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from graphslam.app.run.run import Run
from graphslam.app.sessions.merge import merge


def continue_runs(saved: Sequence[Run | str | Path], run: Run, *, out: str | Path | None = None) -> Any:
    """Put a new run into the graph of saved ones, tied where it was localised in them; the first one's base is fixed.

    What was there before is replaced: the run itself may have been resumed.

    Raises
    ------
    DataError
        It is not found in any of them. The run itself stays as it is.
    """
    return merge([*saved, run], out=out, anew=True)
