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


@pytest.mark.parametrize("text", [" =1", "a=1@", "a=1@nan", "a=1@-0.1", "a=1,", "a=,1", "a=1,inf", "a=1@2@3", "a=yes"])
def test_a_text_that_is_no_setting_is_refused(text):
    with pytest.raises(InputError, match="is no setting such as payload"):
        Setting.parse(text)
