"""What sets of sensors are worth: the documented table, and what the loss of a sensor costs."""

from pathlib import Path

import pytest

from hil.command_line import main
from hil.studies.pose_bound.sets import SETS, evaluate_worth, table

DOCUMENT = Path(__file__).resolve().parents[4] / "docs" / "sensor_sets.md"


def documented():
    """The rows of the table by mechanism and set."""
    rows = (tuple(cell.strip() for cell in line.strip("|").split("|")) for line in DOCUMENT.read_text().splitlines())
    return {row[:2]: row for row in rows if len(row) == len(table([]).headings) and row[1] in {each.label for each in SETS}}


def test_the_documented_table_has_every_set():
    expected = [("hexapod", each.label) for each in SETS]
    expected += [("planar-3rpr", each.label) for each in SETS if each.legs <= 3 and not each.magnetometer]
    assert list(documented()) == expected


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_the_documented_bounds_are_what_is_computed(name):
    sets = [each for each in SETS if each.label in ("tilt", "3 legs + tilt")]
    for row in table(evaluate_worth([name], sets)).rows:
        cells = tuple(cell.text for cell in row)
        for found, written in zip(cells, documented()[cells[:2]], strict=True):
            if " / " not in found:
                assert found == written
            else:
                figures = ([float(part) for part in text.split(" / ")] for text in (found, written))
                assert list(next(figures)) == pytest.approx(next(figures), rel=0.02, abs=0.0011)


@pytest.mark.slow
def test_a_sensor_that_fails_never_makes_it_better():
    for each in evaluate_worth(["6-4-I"], [SETS[4], SETS[6]]):
        for whole, less in ((each.none, each.imu_less), (each.incremental, each.incremental_imu_less)):
            assert less[0] > whole[0] and less[1] > whole[1]
        assert each.encoder_less[0] > 2.0 * each.absolute[0]
        assert each.absolute[0] < each.incremental[0] < each.none[0]


@pytest.mark.slow
def test_the_command_prints_it(tmp_path, capsys):
    path = tmp_path / "worth.json"
    arguments = ["sensor-sets", "--bounds", "--mechanism", "planar-3rpr", "--workers", "1", "--markdown", "--json", str(path)]
    assert main(arguments) == 0
    assert capsys.readouterr().out.count("| planar-3rpr |") == 6
    assert '"encoder_less"' in path.read_text()
