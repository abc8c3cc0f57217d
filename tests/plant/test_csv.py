"""CSV files of numbers: which lines are rows, where each came from, and what is refused with its line."""

import re

import numpy as np
import pytest

from plant.csv import read_csv
from plant.errors import InputError

HEADER = ("time", "x", "y")
OTHER = ("time", "angle")


def write(folder, text):
    path = folder / "data.csv"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("skipped", [0, 2])
def test_rows_come_with_the_lines_of_the_file_that_they_are_on(tmp_path, skipped):
    above = "made by hand\n\n"[: 14 if skipped else 0]
    path = write(tmp_path, "\ufeff" * (not skipped) + above + " time , x,y\r\n0,1.5,-2\n\n  \n 0.1 , 2e-3,3\n")
    table = read_csv(path, OTHER, HEADER, skipped=skipped)
    assert table.columns == HEADER
    np.testing.assert_array_equal(table.rows, [[0.0, 1.5, -2.0], [0.1, 2e-3, 3.0]])
    assert table.lines == [skipped + 2, skipped + 5]


def test_the_columns_are_those_of_the_header_that_the_file_has(tmp_path):
    table = read_csv(write(tmp_path, "time,angle\n1,2\n"), HEADER, OTHER)
    assert table.columns == OTHER and table.rows.shape == (1, 2)


def test_a_file_without_rows_has_none(tmp_path):
    table = read_csv(write(tmp_path, "time,x,y\n\n"), HEADER)
    assert table.rows.shape == (0, 3) and table.lines == []


@pytest.mark.parametrize(
    ("text", "skipped", "said"),
    [
        ("", 0, "data.csv, line 1: the header must be time,x,y or time,angle [SI]"),
        ("x,time,y\n1,2,3", 0, "data.csv, line 1: the header must be"),
        ("time,x,y\n1,2,3", 1, "data.csv, line 2: the header must be"),
        ("time,x,y\n1,2,3\n\n4,5", 0, "data.csv, line 4: '4,5' is not a row of 3 finite numbers: it has 2 numbers"),
        ("title\ntime,x,y\n1,2,3,4", 1, "data.csv, line 3: '1,2,3,4' is not a row of 3 finite numbers: it has 4 numbers"),
        ("time,angle\n1,2,3", 0, "data.csv, line 2: '1,2,3' is not a row of 2 finite numbers: it has 3 numbers"),
        ("time,x,y\n1,nan,3", 0, "line 2: '1,nan,3' is not a row of 3 finite numbers: x is nan"),
        ("time,x,y\n1,2,-inf", 0, "line 2: '1,2,-inf' is not a row of 3 finite numbers: y is -inf"),
        ("time,x,y\n1,two,3", 0, "line 2: '1,two,3' is not a row of 3 finite numbers: could not convert"),
        ("time,x,y\n1,,3", 0, "line 2: '1,,3' is not a row of 3 finite numbers: could not convert"),
    ],
)
def test_a_line_that_is_no_row_is_refused_by_its_number(tmp_path, text, skipped, said):
    with pytest.raises(InputError, match=re.escape(said)):
        read_csv(write(tmp_path, text), HEADER, OTHER, note=" [SI]", skipped=skipped)
