"""Tables as rows, one dict each; pandas is loaded only if a user asks for a DataFrame (63 MB, 0.3 s)."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd


def data_frame(rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Rows as a pandas table with these columns, also if there is no row. Default: the keys of the rows."""
    import pandas as pd

    return pd.DataFrame(list(rows), columns=columns)


def csv_text(rows: Iterable[Mapping[str, Any]], columns: Sequence[str]) -> str:
    """Rows as CSV with a header line; numbers in the shortest form that reads back equal, NaN and None are empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(["" if (v := row.get(c)) is None or v != v else v for c in columns] for row in rows)
    return stream.getvalue()
