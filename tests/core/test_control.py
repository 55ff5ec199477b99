"""Rows of control points: what is read, and what is refused by name."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from graphslam.core.control import ControlTable, MeasuredPlace, control_lines, measured_places
from graphslam.core.errors import DataError, FormatError

HEADER = "name,place,lever,frame,x,y,z,to,distance,sigma"


def parsed(*rows: str) -> ControlTable:
    return ControlTable.parse("points.csv", [HEADER, *rows])


def test_coordinates_distances_and_names():
    found = parsed(
        "gate,12.5,0.5 0.2,gps,3.0,4.0,,,,0.02",
        "# a comment, and an empty line",
        "",
        ",l17,,,5,6,7,,,0.02 0.03 0.04",
        ",gate,,,,,,l17,2.5,0.01",
        ",l3,,,,,,gate,4.5,0.01",
    )
    a, b, c, d = found.rows
    assert not found.refused
    assert (a.line, a.name, a.frame, a.place) == (2, "gate", "gps", MeasuredPlace(12.5, None, (0.5, 0.2)))
    assert b.place == MeasuredPlace(landmark=17)
    assert (b.frame, b.line) == ("survey", 5)
    z, P = b.coordinates(3)
    np.testing.assert_allclose(z, [5, 6, 7])
    np.testing.assert_allclose(np.sqrt(np.diag(P)), [0.02, 0.03, 0.04])
    np.testing.assert_allclose(b.coordinates(2)[0], [5, 6])
    assert (c.place, c.to, c.distance) == (a.place, b.place, 2.5)
    assert (d.to, str(d.place)) == (a.place, "l3")
    with pytest.raises(DataError, match="a map in space needs a height"):
        a.coordinates(3)
    times, lever = measured_places(None, found)
    np.testing.assert_allclose(times, [12.5])
    np.testing.assert_allclose(lever, [0.5, 0.2])


@pytest.mark.parametrize(
    ("row", "why"),
    [
        (",1.0,,mars,1,2,,,,0.1", "frame is not known; got 'mars'; wanted survey or gps"),
        (",1.0,,,1,2,,,,0", "sigma is not above 0; got 0"),
        (",1.0,,,1,2,,,,-1", "sigma is not above 0; got -1"),
        (",1.0,,,1,2,,,,", "sigma is not usable"),
        (",1.0,,,1,2,,,,0.1 0.2 0.3", "sigma is not usable; got '0.1 0.2 0.3'; wanted 1 or 2"),
        (",1.0,,,nan,2,,,,0.1", "x is not finite; got nan"),
        (",1.0,,,1,two,,,,0.1", "y is not a number; got 'two'"),
        (",nan,,,1,2,,,,0.1", "no place has this name; got 'nan'"),
        (",door,,,1,2,,,,0.1", "no place has this name; got 'door'"),
        (",1.0,1,,1,2,,,,0.1", "lever is not usable"),
        (",1.0,,,,,,tower,3,0.1", "no place has this name; got 'tower'"),
        (",1.0,,,1,2,,2.0,3,0.1", "a row has coordinates or a distance"),
        (",1.0,,,,,,,,0.1", "a row has coordinates or a distance"),
        (",1.0,,,1,,,,,0.1", "y is not a number"),
        (",1.0,,,,,,1.0,3,0.1", "a distance is between two places"),
        (",1.0,,,,,,2.0,0,0.1", "a distance is between two places"),
        ("good,3.0,,,1,2,,,,0.1", "name is used twice; got 'good'; wanted another name than that of line 2"),
        (",1.0,,,1,2,,,,0.1,7", "too many cells; got 11"),
    ],
)
def test_rows_are_refused_by_line(row, why):
    found = parsed("good,0.5,,,1,2,,,,0.1", row)
    assert [r.line for r in found.rows] == [2]
    ((line, reason),) = found.refused
    assert line == 3
    assert why in reason


def test_rows_that_contradict_are_both_refused():
    found = parsed(
        ",1.0,,,1,2,,,,0.1", ",1.0,,,1.8,2,,,,0.1", ",1.0,,gps,9,9,,,,0.1", ",2.0,,,1,2,,,,0.1", ",2.0,,,1.6,2,,,,0.1",
        ",1.0,,,,,,l3,5,0.1", ",l3,,,,,,1.0,7,0.1",
    )  # fmt: skip
    assert [r.line for r in found.rows] == [4, 5, 6]  # another frame; and within five standard deviations
    assert [line for line, _ in found.refused] == [2, 3, 7, 8]
    assert "it contradicts line 3; got 0.8 m between them; wanted at most 5 sigma" in found.refused[0][1]


def test_tables_that_are_not_usable():
    with pytest.raises(FormatError, match=r"points\.csv: header of control points is not usable"):
        ControlTable.parse("points.csv", ["time,x,y,sigma", "1,2,3,0.1"])
    with pytest.raises(FormatError, match="header"):
        ControlTable.parse("points.csv", [])
    with pytest.raises(DataError, match=r"no row can be used \(line 2: sigma is not above 0"):
        parsed(",1.0,,,1,2,,,,0")
    with pytest.raises(DataError, match="there is none"):
        parsed()


def test_rows_in_memory_are_those_of_a_file(tmp_path):
    rows = [{"place": 12.5, "lever": [0.5, 0.2], "x": 1 / 3, "y": 2.0, "sigma": 0.02}, {"place": "l3", "to": 12.5}]
    rows[1] |= {"distance": 4.0, "sigma": 0.1}
    given = control_lines(rows)
    path = tmp_path / "points.csv"
    path.write_text("\ufeff" + "\n".join(given["rows"]))
    assert control_lines(path) == {"source": "points.csv", "rows": given["rows"]}
    assert control_lines(given) == given
    by_table = control_lines(pd.DataFrame(rows))
    a, b = (ControlTable.parse("", g["rows"]).rows for g in (given, by_table))
    assert [r.place for r in a] == [r.place for r in b]
    assert a[0].position[0] == b[0].position[0] == 1 / 3
    with pytest.raises(DataError, match="control points are not usable; got float"):
        control_lines(3.0)
