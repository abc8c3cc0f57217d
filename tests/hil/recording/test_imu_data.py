"""Readings of a single IMU: which columns of a file are which, in which units, and which files are refused."""

import numpy as np
import pytest

from hil.loop.records import RECORD
from hil.recording.imu_data import read_field, read_imu
from hil.recording.mcap import Recorder
from plant.errors import InputError

NAMES = ["time_s", "wx", "wy", "wz", "ax", "ay", "az", "mx", "my", "mz"]


def write(path, *columns, times=(5.0, 5.02, 5.04)):
    """A file with these columns, each of values of its own; returns the values by name."""
    table = np.array([[at, *(10.0 * k + 0.1 * row for k in range(1, 10))] for row, at in enumerate(times)])
    values = dict(zip(NAMES, table.T, strict=True))
    lines = [",".join(columns), *(",".join(repr(float(values[name][row])) for name in columns) for row in range(len(times)))]
    path.write_text("\n".join(lines) + "\n")
    return values


def stacked(values, *names):
    return np.column_stack([values[name] for name in names])


@pytest.mark.parametrize("count", [7, 10])
def test_a_file_gives_times_rates_and_forces(tmp_path, count):
    path = tmp_path / "imu.csv"
    values = write(path, *NAMES[:count])
    # A file has one IMU, whichever it is of the mechanism.
    times, rates, forces = read_imu(path, 4)
    np.testing.assert_array_equal(times, values["time_s"])
    np.testing.assert_array_equal(rates, stacked(values, "wx", "wy", "wz"))
    np.testing.assert_array_equal(forces, stacked(values, "ax", "ay", "az"))


@pytest.mark.parametrize("columns", [NAMES, ["time_s", "mx", "my", "mz"]])
def test_a_file_gives_fields_and_the_forces_if_it_has_any(tmp_path, columns):
    path = tmp_path / "field.csv"
    values = write(path, *columns)
    fields, forces = read_field(path, 4)
    np.testing.assert_array_equal(fields, stacked(values, "mx", "my", "mz"))
    if len(columns) == 10:
        np.testing.assert_array_equal(forces, stacked(values, "ax", "ay", "az"))
    else:
        assert forces is None


def test_a_recording_gives_the_imu_of_the_number_in_seconds(tmp_path):
    path, records = tmp_path / "run.mcap", np.zeros(3, RECORD)
    records["cycle"], records["time_ns"] = np.arange(3), [7, 2_000_000_007, 4_000_000_007]
    for name in ("angular_velocity", "specific_force", "magnetic_field"):
        records[name] = np.random.default_rng(len(name)).normal(size=(3, 7, 3))
    records["base_imu"] = np.random.default_rng(0).normal(size=(3, 2, 3))
    recorder = Recorder(path, {"config": {"version": "0"}}, 10**18)
    recorder.write(records)
    recorder.close()
    times, rates, forces = read_imu(path, 5)
    assert times == pytest.approx([7e-9, 2.0 + 7e-9, 4.0 + 7e-9], rel=1e-15)
    np.testing.assert_array_equal(rates, records["angular_velocity"][:, 5])
    np.testing.assert_array_equal(forces, records["specific_force"][:, 5])
    _, rates, forces = read_imu(path, 7)
    np.testing.assert_array_equal(np.stack([rates, forces], axis=1), records["base_imu"])
    fields, forces = read_field(path, 2)
    np.testing.assert_array_equal(fields, records["magnetic_field"][:, 2])
    np.testing.assert_array_equal(forces, records["specific_force"][:, 2])


@pytest.mark.parametrize("step", [0.5, 1.5])
def test_samples_may_come_half_a_period_early_or_late(tmp_path, step):
    times = np.cumsum([1.0, 1.0, 1.0, step, 1.0])
    write(tmp_path / "imu.csv", *NAMES, times=times)
    np.testing.assert_array_equal(read_imu(tmp_path / "imu.csv", 0)[0], times)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ((0.0, 1.0, 2.0, 3.51, 4.51), "line 5: the samples must be evenly spaced, 1 s as most are"),
        ((0.0, 1.0, 2.0, 2.49, 3.49), "line 5: the samples must be evenly spaced, 1 s"),
        ((0.0, 1.0, 2.0, 1.0, 2.0), "line 5"),
        ((3.0, 2.0, 1.0), "line 3: the samples must be evenly spaced, -1 s"),
        ((1.0, 1.0, 1.0), "line 2: the samples must be evenly spaced, 0 s"),
        ((1.0,), "has 1 rows of numbers; it needs two or more"),
    ],
)
def test_what_is_not_evenly_spaced_is_refused_with_its_line(tmp_path, times, said):
    write(tmp_path / "imu.csv", *NAMES[:7], times=times)
    with pytest.raises(InputError, match=said):
        read_imu(tmp_path / "imu.csv", 0)


def test_other_columns_are_refused(tmp_path):
    path = tmp_path / "imu.csv"
    write(path, "time_s", "mx", "my", "mz")
    with pytest.raises(InputError, match="the header must be time_s,wx,wy,wz,ax,ay,az or time_s"):
        read_imu(path, 0)
    write(path, *NAMES[:7])
    with pytest.raises(InputError, match="the header must be time_s,wx,wy,wz,ax,ay,az,mx,my,mz or time_s,mx,my,mz"):
        read_field(path, 0)
