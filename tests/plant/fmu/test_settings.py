"""Settings as a user writes them: what the text means, and that it can be written again."""

import pytest

from plant.errors import InputError
from plant.fmu.settings import Setting


@pytest.mark.parametrize(
    ("text", "setting"),
    [
        ("payload.mass=12", Setting("payload.mass", (12.0,), None)),
        (" payload.mass = 12 @ 3.5 ", Setting("payload.mass", (12.0,), 3.5)),
        ("payload.mass=-1e-3@0", Setting("payload.mass", (-1e-3,), 0.0)),
        ("on=true,false, true", Setting("on", (1.0, 0.0, 1.0), None)),
    ],
)
def test_a_text_is_a_setting(text, setting):
    found = Setting.parse(text)
    assert found == setting
    # A change at time 0 is not a value from the start.
    assert (found.at is None) == (setting.at is None)


@pytest.mark.parametrize("text", ["gravity=0,-9.5,2.25", "payload.mass=12@3.5", "a[1,2]=1@0"])
def test_a_setting_is_written_as_it_is_read(text):
    assert Setting.parse(text).text == text


@pytest.mark.parametrize("text", [" =1", "a", ""])
def test_a_text_that_is_no_setting_is_refused(text):
    with pytest.raises(InputError, match="is no setting such as payload"):
        Setting.parse(text)


@pytest.mark.parametrize("value", ["1,", ",1", "1,inf", "yes", "nan", "15kg", ""])
def test_a_value_that_is_no_finite_number_is_named(value):
    with pytest.raises(InputError, match=f"'a={value}' is no setting: '{value}' must be a finite number without a unit"):
        Setting.parse(f"a={value}")


@pytest.mark.parametrize("time", ["", "nan", "-0.1", "2@3", "inf"])
def test_a_time_that_is_none_is_named(time):
    with pytest.raises(InputError, match=f"'a=1@{time}' is no setting: '{time}' must be a time in seconds from 0 on"):
        Setting.parse(f"a=1@{time}")
