"""Reading TOML: every error names the file, and every unknown entry the known ones."""

import pytest

from plant.errors import InputError
from plant.files import check_entries, read_toml, unknown_entries


def test_a_file_is_read(tmp_path):
    path = tmp_path / "good.toml"
    path.write_text("[rig]\nname = 'µ'\n", encoding="utf-8")
    assert read_toml(path) == {"rig": {"name": "µ"}}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, r"cannot read .*file\.toml: No such file"),
        (b"\xff", r"cannot read .*file\.toml: it is not UTF-8 text"),
        (b"[rig", r"file\.toml is not valid TOML: "),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path, content, said):
    path = tmp_path / "file.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_toml(path)


def test_unknown_entries_are_named_with_the_known_ones():
    table = {"speed": 1, "mass": 2, "color": 3}
    assert unknown_entries(table, ("mass", "inertia"), "[body]") == [
        "[body] has no entry 'speed'; it has mass, inertia",
        "[body] has no entry 'color'; it has mass, inertia",
    ]
    check_entries({"mass": 2}, ("mass", "inertia"), "[body]")
    with pytest.raises(InputError, match=r"\[body\] has no entry 'speed'"):
        check_entries(table, ("mass", "inertia"), "[body]")
