"""Files that a command writes, each completely or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graphslam.core.atomic import atomic_open
from graphslam.core.json_file import json_values

if TYPE_CHECKING:
    import pandas as pd


class OutputFiles:
    """Writes files of a folder, each completely or not at all."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @property
    def figures(self) -> Path:
        """Folder for PNG files, created at first use."""
        folder = self.path / "figures"
        folder.mkdir(exist_ok=True)
        return folder

    def write_json(self, name: str, value: Any) -> None:
        """Write a JSON file; not-a-number becomes null."""
        with atomic_open(self.path / name, "w") as stream:
            stream.write(json.dumps(json_values(value), indent=1, allow_nan=False) + "\n")

    def write_lines(self, name: str, rows: Iterable[Mapping[str, Any]]) -> None:
        """Write JSON lines."""
        with atomic_open(self.path / name, "w") as stream:
            stream.write(json_lines(rows))

    def write_text(self, name: str, text: str) -> None:
        """Write a text file."""
        with atomic_open(self.path / name, "w") as stream:
            stream.write(text)

    def write_table(self, name: str, table: pd.DataFrame) -> None:
        """Write a table as CSV: the shortest digits that read back as the same number, with pandas' ``round_trip``."""
        with atomic_open(self.path / name, "w") as stream:
            table.to_csv(stream, index=False, na_rep="nan", lineterminator="\n")


def json_lines(rows: Iterable[Mapping[str, Any]]) -> str:
    """One JSON object per line."""
    return "".join(json.dumps(json_values(row), allow_nan=False) + "\n" for row in rows)
