"""A commented file of options for a log: every option with meaning and value, none of them set."""

from __future__ import annotations

import ast
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

from graphslam.app.option_table import option_rows
from graphslam.app.run.choice import choose_front_end
from graphslam.app.run.front_ends import recommended_options
from graphslam.core.config import dump_toml
from graphslam.core.log import SensorLog


def config_file(log: SensorLog, source: str, frontend: str | None = None) -> str:
    """Text of a TOML file for ``graphslam run --config``. All options are comments, so that it changes nothing yet.

    Parameters
    ----------
    source : str
        Name or path of the log, for the command in the first lines.
    frontend : str, optional
        Default: by the streams of the log.
    """
    choice = choose_front_end(log) if frontend is None else None
    name, why = (frontend, "as asked for") if choice is None else (choice.frontend, choice.why)
    assert name is not None
    preset = dict(_flat(recommended_options(log, name)))
    out = [
        f"# Options for {log.name}, front end {name} ({why}).",
        f"# graphslam run {source} --frontend {name} --config THIS-FILE --out FOLDER",
        "# Remove the # before an option to set it. [preset]: the value that is recommended for this log.",
        "# A noise that is set here is not estimated from the log.",
    ]
    for row in [*option_rows(name), *option_rows()]:
        value, mark = (preset[row.option], "  # [preset]") if row.option in preset else (_literal(row.default), "")
        out += ["", *textwrap.wrap(row.meaning, 116, initial_indent="#   ", subsequent_indent="#   ")]
        text = " ".join(dump_toml({"value": value}).partition("=")[2].split()) if _has_toml(value) else None
        out.append(f"# {row.option} = {'…' if text is None else text}{mark}" + ("" if text else f"  # {row.default}"))
    return "\n".join([*out, ""])


def _flat(values: Mapping[str, Any], where: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{where}{key}.")
        else:
            yield where + key, value


def _literal(default: str) -> Any:
    """Value of a default; None if it is no literal."""
    try:
        return float(default) if default in ("inf", "nan") else ast.literal_eval(default)
    except (ValueError, SyntaxError):
        return None


def _has_toml(value: Any) -> bool:
    """Whether TOML has such values, on one line."""
    if isinstance(value, (list, tuple)):
        return all(isinstance(v, (bool, int, float, str)) for v in value)
    return isinstance(value, (bool, int, float, str))
