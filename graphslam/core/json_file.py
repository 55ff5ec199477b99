"""Checked reading of JSON: finite numbers, every key once, values of the declared type."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

from graphslam.core.errors import FormatError
from graphslam.core.reading import LARGEST, read_text

MOST_NESTED = 64
"""Most levels of lists and mappings."""


def _constant(word: str) -> Any:
    raise ValueError(f"{word} is no JSON")


def _float(word: str) -> float:
    value = float(word)
    if not abs(value) <= LARGEST:
        raise ValueError(f"number {word[:40]} is too large; wanted at most {LARGEST:g}")
    return value


def _int(word: str) -> int:
    if len(word) > 20 or abs(int(word)) >= 2**64:
        raise ValueError(f"whole number {word[:40]} is too large; wanted at most 64 bits")
    return int(word)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) != len(pairs):
        names = [k for k, _ in pairs]
        raise ValueError(f"key {next(k for k in names if names.count(k) > 1)[:40]!r} is given twice")
    return made


def parse_json(text: str, where: str) -> Any:
    """The value of a JSON text: finite numbers, every key once, no more than :data:`MOST_NESTED` levels."""
    try:
        value = json.loads(
            text, parse_constant=_constant, parse_float=_float, parse_int=_int, object_pairs_hook=_object
        )
    except RecursionError:
        raise FormatError("JSON is nested too deeply", where=where, wanted=f"{MOST_NESTED} levels at most") from None
    except ValueError as error:
        raise FormatError(f"not JSON, or truncated ({error})", where=where) from None
    stack = [(value, 0)]
    while stack:
        v, depth = stack.pop()
        if isinstance(v, str):
            if not v.isascii() and any("\ud800" <= c <= "\udfff" for c in v):
                raise FormatError("JSON holds half a character", where=where, got=ascii(v[:40]))
        elif isinstance(v, (dict, list)):
            if depth >= MOST_NESTED:
                raise FormatError("JSON is nested too deeply", where=where, wanted=f"{MOST_NESTED} levels at most")
            inside = [*v, *v.values()] if isinstance(v, dict) else v
            stack += [(x, depth + 1) for x in inside]
    return value


def check_json(value: Any, shape: Any, where: str, at: str = "") -> Any:
    """Return the value if it has the declared shape.

    Parameters
    ----------
    value : object
        From :func:`parse_json`.
    shape : object
        ``int``, ``float`` (whole numbers, too), ``str``, ``bool``, ``None`` or ``object`` (anything); ``[shape]`` for a
        list of any length, ``(shape, shape)`` for a list of that length; ``{key: shape}`` for a mapping, where a key
        that ends in ``?`` may be missing or null and other keys are ignored, ``{str: shape}`` for a mapping of any
        keys.
    where, at : str
        File, and place in it.
    """
    place = f" of {at}" if at else ""
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            raise FormatError(f"not a mapping{place}", where=where, got=_text(value), wanted="a JSON object")
        if str in shape:
            for k, v in value.items():
                check_json(v, shape[str], where, f"{at}.{k[:40]}".lstrip("."))
            return value
        for key, inner in shape.items():
            name = key.removesuffix("?")
            inside = f"{at}.{name}".lstrip(".")
            if value.get(name) is None and name != key:
                continue
            if name not in value:
                raise FormatError(f"key {name!r} is missing{place}", where=where, wanted=_words(inner))
            check_json(value[name], inner, where, inside)
        return value
    if isinstance(shape, (list, tuple)):
        if not isinstance(value, list) or (isinstance(shape, tuple) and len(value) != len(shape)):
            raise FormatError(f"not a list{place}", where=where, got=_text(value), wanted=_words(shape))
        for k, v in enumerate(value):
            check_json(v, shape[0] if isinstance(shape, list) else shape[k], where, f"{at}[{k}]")
        return value
    right = {
        int: isinstance(value, int) and not isinstance(value, bool),
        float: isinstance(value, (int, float)) and not isinstance(value, bool),
        str: isinstance(value, str),
        bool: isinstance(value, bool),
        None: value is None,
        object: True,
    }[shape]
    if not right:
        raise FormatError(f"value of the wrong type{place}", where=where, got=_text(value), wanted=_words(shape))
    return value


def _text(value: Any) -> str:
    text = repr(value)
    return f"{type(value).__name__} {text if len(text) <= 60 else text[:57] + '…'}"


def _words(shape: Any) -> str:
    if isinstance(shape, dict):
        return "a JSON object"
    if isinstance(shape, tuple):
        return f"a list of {len(shape)}"
    if isinstance(shape, list):
        return "a list"
    return {int: "a whole number", float: "a number", str: "text", bool: "true or false"}.get(shape, "null")


def read_json_lines(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The JSON objects of a file with one per line."""
    out = []
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        if not line:
            continue
        where = f"{path}, line {number}"
        value = parse_json(line, where)
        if not isinstance(value, dict):
            raise FormatError("not a JSON object", where=where, got=_text(value))
        out.append(value)
    return out


def json_values(value: Any) -> Any:
    """The value with NumPy scalars as Python numbers and non-finite numbers as None (JSON has none)."""
    if isinstance(value, Mapping):
        return {str(k): json_values(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_values(v) for v in value]
    if hasattr(value, "tolist"):
        return json_values(value.tolist())
    if isinstance(value, float) and (value != value or value in (float("inf"), float("-inf"))):
        return None
    return value
