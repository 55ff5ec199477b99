"""What a notebook needs and a program does not: to end early with a sentence instead of ten screens of traceback."""

from __future__ import annotations

from typing import Any

from graphslam.core.errors import MissingDataError
from graphslam.io.cards import find_card
from graphslam.io.catalog import DATA_VARIABLE, load_recording


class NotebookStop(Exception):
    """Ends a notebook. IPython shows the message alone; "run all" stops at the cell."""

    def _render_traceback_(self) -> list[str]:
        """What IPython prints in place of a traceback."""
        return str(self).splitlines()


def load_or_stop(name: str) -> Any:
    """Load a recorded data set by its name; where it is missing, end the notebook and say how to get it.

    Raises
    ------
    NotebookStop
        The files are not on this machine.
    UnknownNameError, DataError
    """
    try:
        return load_recording(name)
    except MissingDataError as error:
        c = find_card(name)
        get = f"graphslam data fetch {name}" if c.fetchable else f"(no direct download) a copy from {c.source}"
        raise NotebookStop(
            f"This notebook needs the recorded data set {name!r}, which is not on this machine ({error.what}).\n"
            f"  what it is   {c.title}, {c.bytes / 1e6:.1f} MB\n"
            f"  terms        {c.licence}. {c.terms}\n"
            f"  to get it    {get}\n"
            f"  or           set {DATA_VARIABLE} to the folder that holds {c.folder}/\n"
            "Then run the notebook again from the top. The five-minute tour (00) needs no data."
        ) from None
