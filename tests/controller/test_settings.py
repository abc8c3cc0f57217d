"""Settings: defaults, the preset's tables, changes by name, and what is refused."""

from dataclasses import FrozenInstanceError, asdict, fields

import numpy as np
import pytest

from controller.settings import ControlSettings, FusionSettings, control_settings, fusion_settings
from plant.errors import GoughError, InputError
from plant.mechanism import Mechanism

KINDS = [(ControlSettings, control_settings, "control"), (FusionSettings, fusion_settings, "fusion")]


def mechanism_with(hexapod, **tables):
    return Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, settings=tables)


@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_without_a_table_the_defaults_stand(hexapod, kind, read, table):
    assert read(mechanism_with(hexapod)) == kind()
    assert read(mechanism_with(hexapod, **{table: {}})) == kind()


def test_a_preset_and_then_a_change_by_name_take_precedence(hexapod):
    mechanism = mechanism_with(hexapod, control={"proportional": 20.0, "hold": 0.5}, fusion={"leg_sigma": 1e-3})
    assert control_settings(mechanism) == ControlSettings(proportional=20.0, hold=0.5)
    assert control_settings(mechanism, hold=0.3) == ControlSettings(proportional=20.0, hold=0.3)
    assert fusion_settings(mechanism) == FusionSettings(leg_sigma=1e-3)
    assert fusion_settings(mechanism, leg_sigma=2e-3, tilt_sigma=3e-3) == FusionSettings(leg_sigma=2e-3, tilt_sigma=3e-3)
    # A whole number in a file is a number.
    assert control_settings(mechanism_with(hexapod, control={"proportional": 20})).proportional == 20.0


def test_the_hexapods_gains_lie_in_the_range_of_the_design(hexapod):
    control = control_settings(hexapod)
    assert 30.0 <= control.proportional <= 60.0
    assert 60.0 <= control.integral <= 200.0
    assert control.hold >= 0.2


@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_an_unknown_name_in_a_table_is_refused_with_the_known_ones(hexapod, kind, read, table):
    with pytest.raises(InputError, match="nonsense") as caught:
        read(mechanism_with(hexapod, **{table: {"nonsense": 1.0}}))
    assert isinstance(caught.value, GoughError)
    for field in fields(kind):
        assert field.name in str(caught.value)


@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_an_unknown_name_among_the_changes_is_refused(hexapod, kind, read, table):
    with pytest.raises(InputError, match="nonsense"):
        read(hexapod, nonsense=1.0)


@pytest.mark.parametrize("value", ["fast", [1.0, 2.0], None, {}])
def test_what_is_no_number_is_refused_in_tables_and_changes(hexapod, value):
    with pytest.raises(InputError, match="proportional"):
        control_settings(mechanism_with(hexapod, control={"proportional": value}))
    with pytest.raises(InputError, match="proportional"):
        control_settings(hexapod, proportional=value)


@pytest.mark.parametrize("bad", [-1.0, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("kind", "read", "table"), KINDS)
def test_a_bad_value_of_any_setting_is_refused_by_name(hexapod, kind, read, table, bad):
    for name in asdict(kind()):
        with pytest.raises(InputError, match=name):
            read(hexapod, **{name: bad})
        with pytest.raises(InputError, match=name):
            read(mechanism_with(hexapod, **{table: {name: bad}}))


def test_zero_is_allowed_only_where_it_switches_something_off(hexapod):
    off = control_settings(hexapod, integral=0.0, derivative=0.0)
    assert (off.integral, off.derivative) == (0.0, 0.0)
    for kind, read, _ in KINDS:
        for field in fields(kind):
            if field.name not in ("integral", "derivative", "sensor_delay"):
                with pytest.raises(InputError, match=field.name):
                    read(hexapod, **{field.name: 0.0})


def test_settings_do_not_change_once_built():
    with pytest.raises(FrozenInstanceError):
        ControlSettings().proportional = 1.0
    with pytest.raises(FrozenInstanceError):
        FusionSettings().leg_sigma = 1.0
