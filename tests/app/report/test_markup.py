"""Text becomes text of a page, whatever it holds; markup stays markup."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from graphslam.core.markup import (
    Markup,
    escape_text,
    html_element,
    html_table,
    is_numeric,
    join_parts,
    pair_list,
    value_text,
)
from tests.reference.page import Page

HOSTILE = "<script>alert(1)</script>\"' onload=x &amp; </td></table>"


def page(body: Markup) -> Page:
    return Page(f'<html><body><section id="s">{body}</section></body></html>')


@given(st.text())
def test_any_text_comes_back_as_it_was(text: str) -> None:
    fit = "".join("\ufffd" if _unfit(c) else c for c in text)
    got = page(html_table([{"a": text}], ["a"])).tables[0].rows[1][0]
    # line ends are the parser's: HTML reads \r as \n
    assert got.replace("\r\n", "\n").replace("\r", "\n") == fit.replace("\r\n", "\n").replace("\r", "\n")
    escape_text(text).encode("utf-8")


def _unfit(c: str) -> bool:
    n = ord(c)
    control = n < 32 and c not in "\t\n\r"
    return control or 127 <= n < 160 or 0xD800 <= n < 0xE000 or n in (0xFFFE, 0xFFFF)


def test_hostile_text_is_text_everywhere() -> None:
    body = join_parts(
        [
            html_element("p", HOSTILE, title=HOSTILE),
            html_table([{HOSTILE: HOSTILE, "b": {HOSTILE: [HOSTILE]}}], [HOSTILE, "b"]),
            pair_list({HOSTILE: HOSTILE}),
        ]
    )
    found = page(body)
    assert found.tags == {"html", "body", "section", "p", "div", "table", "thead", "tbody", "tr", "th", "td"}
    assert found.attributes <= {"id", "title", "class", "scope"}
    assert found.sections["s"].count("alert(1)") == 7
    assert found.tables[0].rows[1][0] == HOSTILE
    assert html_element("p", html_element("b", "x")) == "<p><b>x</b></p>"  # markup is not escaped twice


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (None, "–"),
        (math.nan, "–"),
        (0.1234567, "0.123457"),
        (1e300, "1e+300"),
        (math.inf, "inf"),
        (12, "12"),
        (True, "yes"),
        (np.float64(2.5), "2.5"),
        (np.array([1.0, 2.0]), "1, 2"),
        ([1.5, None], "1.5, –"),
        ({"a": 0.5, "b": [1, 2]}, "a 0.5, b 1, 2"),
        ("text", "text"),
        ([], "–"),
    ],
)
def test_values_as_cells_show_them(value: object, said: str) -> None:
    assert value_text(value) == said


def test_only_numbers_stand_to_the_right() -> None:
    assert [is_numeric(v) for v in (1, 1.0, np.float64(1.0), True, "1", None)] == [
        True,
        True,
        True,
        False,
        False,
        False,
    ]
