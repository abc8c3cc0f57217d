"""Descriptions of FMUs: what each variable is, scalars that form an array, and values of every type."""

import re
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plant.errors import FmuError, InputError, UnknownNameError
from plant.fmu.description_reader import FmuDescription, FmuVariable, element_names
from tests.plant.fmu.foreign import edited

TUNABLE = 'causality="parameter" variability="tunable"'


def scalar(name: str, reference: int, role: str, value: str) -> str:
    return f'<ScalarVariable name="{name}" valueReference="{reference}" {role}>{value}</ScalarVariable>'


VARIABLES = [
    # A matrix whose elements come in another order than their rows, and whose references follow neither.
    scalar("m[2,1]", 21, TUNABLE, '<Real start="0" unit="kg" min="-1"/>'),
    scalar("m[1,1]", 15, TUNABLE, '<Real start="0" unit="kg" min="0" max="9"/>'),
    scalar("m[1,3]", 13, TUNABLE, '<Real start="0" unit="kg"/>'),
    scalar("m[2,3]", 23, TUNABLE, '<Real start="0" unit="kg"/>'),
    scalar("m[1, 2]", 12, TUNABLE, '<Real start="0" unit="kg" max="8"/>'),
    scalar("m[2,2]", 22, TUNABLE, '<Real start="0" unit="kg"/>'),
    # Arrays with a gap, of two units, of two dimensions, and one beside a scalar of its name.
    scalar("gap[1]", 31, 'causality="input"', '<Real start="0"/>'),
    scalar("gap[3]", 33, 'causality="input"', '<Real start="0"/>'),
    scalar("mixed[1]", 41, 'causality="input"', '<Real start="0" unit="m"/>'),
    scalar("mixed[2]", 42, 'causality="input"', '<Real start="0" unit="kg"/>'),
    scalar("roles[1]", 43, 'causality="input"', '<Real start="0"/>'),
    scalar("roles[2]", 44, 'causality="output"', "<Real/>"),
    scalar("odd[1]", 45, 'causality="input"', '<Real start="0"/>'),
    scalar("odd[1,1]", 46, 'causality="input"', '<Real start="0"/>'),
    scalar("own", 51, 'causality="input"', '<Real start="0"/>'),
    scalar("own[1]", 52, 'causality="input"', '<Real start="0"/>'),
    scalar("on", 60, 'causality="input" variability="discrete"', '<Boolean start="false"/>'),
    scalar("count", 61, 'causality="parameter" variability="fixed"', '<Integer start="3" min="1" max="5"/>'),
    scalar("title", 62, 'causality="parameter" variability="fixed"', '<String start="a"/>'),
    scalar("typed", 63, 'causality="parameter" variability="fixed"', '<Real declaredType="Distance" start="1"/>'),
    scalar("set", 64, 'causality="local" initial="exact"', '<Real start="1"/>'),
    scalar("found", 65, 'causality="local" initial="calculated"', "<Real/>"),
    scalar("pi", 66, 'causality="local" variability="constant" initial="exact"', '<Real start="3"/>'),
    scalar("out", 67, 'causality="output"', "<Real/>"),
]  # fmt: skip
OUTPUTS = [i for i, text in enumerate(VARIABLES, 1) if 'causality="output"' in text]


def write(folder: Path, attributes: str = "", head: str = "", variables: list[str] = VARIABLES) -> Path:
    path = folder / "small.fmu"
    outputs = "".join(f'<Unknown index="{i}"/>' for i in OUTPUTS)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "modelDescription.xml",
            '<?xml version="1.0" encoding="UTF-8"?>'
            f'<fmiModelDescription fmiVersion="2.0" modelName="small" guid="{{small}}"{head}>'
            f'<CoSimulation modelIdentifier="small" {attributes}/>'
            '<UnitDefinitions><Unit name="m"/><Unit name="kg"/><Unit name="mm"/></UnitDefinitions>'
            '<TypeDefinitions><SimpleType name="Distance"><Real unit="mm"/></SimpleType></TypeDefinitions>'
            f"<ModelVariables>{''.join(variables)}</ModelVariables>"
            f"<ModelStructure><Outputs>{outputs}</Outputs><InitialUnknowns>{outputs}</InitialUnknowns></ModelStructure>"
            "</fmiModelDescription>",
        )
    return path


@pytest.fixture
def description(tmp_path: Path) -> FmuDescription:
    return FmuDescription(write(tmp_path))


def test_scalars_form_an_array_row_by_row_whatever_their_order(description: FmuDescription) -> None:
    matrix = description["m"]
    assert (matrix.name, matrix.shape, matrix.size) == ("m", (2, 3), 6)
    assert matrix.references == (15, 12, 13, 21, 22, 23)
    endless = np.inf
    assert matrix.limits == (
        (0.0, 9.0), (-endless, 8.0), (-endless, endless), (-1.0, endless), (-endless, endless), (-endless, endless)
    )  # fmt: skip
    assert (matrix.minimum, matrix.maximum) == (-endless, endless)
    assert (matrix.unit, matrix.tunable, matrix.startable, matrix.real) == ("kg", True, True, True)
    assert matrix.element_names == ["m[1,1]", "m[1,2]", "m[1,3]", "m[2,1]", "m[2,2]", "m[2,3]"]
    # An element is a variable by itself.
    assert description["m[2,1]"].references == (21,) and description["m[2,1]"].shape == ()


@pytest.mark.parametrize("name", ["gap", "mixed", "roles", "odd", "missing"])
def test_scalars_that_do_not_belong_together_are_no_array(description: FmuDescription, name: str) -> None:
    assert name not in description
    with pytest.raises(UnknownNameError, match=f"small.fmu has no variable '{name}'"):
        description[name]


def test_a_scalar_goes_before_an_array_of_its_name(description: FmuDescription) -> None:
    assert description["own"].references == (51,)


def test_each_kind_of_variable_is_told_apart(description: FmuDescription) -> None:
    kinds = {
        name: (each.type, each.ending, each.real, each.tunable, each.startable)
        for name, each in (
            (name, description[name]) for name in ("on", "count", "title", "set", "found", "pi", "out", "m[1,1]")
        )
    }
    assert kinds == {
        "on": ("Boolean", "Boolean", False, True, True),
        "count": ("Integer", "Integer", False, False, True),
        "title": ("String", "", False, False, True),
        "set": ("Real", "Real", True, False, True),
        "found": ("Real", "Real", True, False, False),
        "pi": ("Real", "Real", True, False, False),
        "out": ("Real", "Real", True, False, False),
        "m[1,1]": ("Real", "Real", True, True, True),
    }
    assert (description["count"].minimum, description["count"].maximum) == (1.0, 5.0)
    assert (description["typed"].unit, description["out"].unit) == ("mm", None)
    assert [each.name for each in description][:2] == ["m[2,1]", "m[1,1]"]
    assert description.states == ()


@pytest.mark.parametrize(
    ("attributes", "saves", "differentiable"),
    [
        ("", False, False),
        ('canGetAndSetFMUstate="true"', False, False),
        ('canGetAndSetFMUstate="true" canSerializeFMUstate="true"', True, False),
        ('providesDirectionalDerivative="true"', False, True),
        ('providesDirectionalDerivative="false"', False, False),
    ],
)
def test_abilities_are_what_the_description_promises(
    tmp_path: Path, attributes: str, saves: bool, differentiable: bool
) -> None:
    found = FmuDescription(write(tmp_path, attributes, ' generationTool="hand"'))
    assert (found.version, found.token, found.tool) == (2, "{small}", "hand")
    assert (found.saves_state, found.differentiable) == (saves, differentiable)


def test_states_come_with_their_rates(tmp_path: Path, fmu_path: Path) -> None:
    states = FmuDescription(fmu_path).states
    names = "position quaternion velocity angular_velocity current brake_deflection bending bending_rate play play_velocity"
    expected = [(f"state.{name}", f"der(state.{name})") for name in names.split()]
    assert [(state.name, rate.name) for state, rate in states] == expected
    assert all(state.shape == rate.shape for state, rate in states)


def test_what_is_no_description_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    with pytest.raises(FmuError, match="folder is a folder: name the FMU's file"):
        FmuDescription(tmp_path / "folder")
    with pytest.raises(FmuError, match=r"there is no FMU at .*none\.fmu"):
        FmuDescription(tmp_path / "none.fmu")
    twice = [*VARIABLES, scalar("out", 99, 'causality="local"', "<Real/>")]
    with pytest.raises(FmuError, match=r"small\.fmu is not a usable FMU"):
        FmuDescription(write(tmp_path, variables=twice))


@pytest.mark.parametrize("control", ["\x9b31m", "&#x9b;31m", "&#x85;", "&#x7f;"])
@pytest.mark.parametrize("where", ["name", "unit", "tool"])
def test_control_characters_in_a_description_are_refused_and_not_shown(tmp_path: Path, control: str, where: str) -> None:
    more: dict[str, Any] = {"head": f' generationTool="a{control}"'} if where == "tool" else {}
    if where == "name":
        more["variables"] = [*VARIABLES, scalar(f"a{control}", 99, 'causality="local"', "<Real/>")]
    if where == "unit":
        more["variables"] = [*VARIABLES, scalar("a", 99, 'causality="local"', f'<Real unit="{control}"/>')]
    with pytest.raises(FmuError) as refused:
        FmuDescription(write(tmp_path, **more))
    assert str(refused.value).isprintable() and "small.fmu is not a usable FMU" in str(refused.value)


def test_a_description_may_have_lines_and_letters_of_any_script(tmp_path: Path) -> None:
    found = FmuDescription(write(tmp_path, head=' description="a&#10;b &#9;" generationTool="Größe 漢"'))
    assert found.tool == "Größe 漢"


# ---- values ----


def variable(kind: str, dtype: Any, shape: tuple[int, ...] = (2, 2)) -> FmuVariable:
    size = int(np.prod(shape))
    limits = ((-np.inf, np.inf),) * size
    return FmuVariable("v", shape, kind, "input", "discrete", None, limits, True, (0,), kind, np.dtype(dtype))


@pytest.mark.parametrize("dtype", ["float64", "float32", "int8", "uint16", "int64"])
def test_values_go_row_by_row_in_the_variables_type(dtype: str) -> None:
    values = variable("Number", dtype).values([[1, 2], [3, 4]], "some.fmu")
    assert values.dtype == np.dtype(dtype) and values.tolist() == [1, 2, 3, 4]


def test_one_number_stands_for_all_only_where_it_may() -> None:
    array = variable("Float64", "float64")
    assert array.values(0.5, "some.fmu", spread=True).tolist() == [0.5] * 4
    for given, spread, count in ((0.5, False, 1), ([1.0, 2.0], True, 2), ([1.0] * 5, True, 5), ([], True, 0)):
        with pytest.raises(InputError, match=f"v of some.fmu has 4 elements, got {count}"):
            array.values(given, "some.fmu", spread)


@pytest.mark.parametrize(
    ("kind", "dtype", "given", "needed"),
    [
        ("Int32", "int32", 1.5, "whole numbers"),
        ("Int32", "int32", np.nan, "whole numbers"),
        ("Boolean", "bool", 2.0, "true or false"),
        ("Boolean", "int32", -1.0, "true or false"),
    ],
)
def test_what_a_type_cannot_hold_is_refused(kind: str, dtype: str, given: float, needed: str) -> None:
    with pytest.raises(InputError, match=f"v of some.fmu must be {needed}, got {given}"):
        variable(kind, dtype, ()).values(given, "some.fmu")


def test_a_boolean_is_one_or_zero_in_its_own_width() -> None:
    assert variable("Boolean", "bool", (2,)).values([1, 0], "some.fmu").tolist() == [True, False]
    assert variable("Boolean", "int32", (2,)).values([1, 0], "some.fmu").tolist() == [1, 0]
    with pytest.raises(InputError, match=r"v of some\.fmu is a String and takes no numbers"):
        replace(variable("String", "float64"), ending="").values(1.0, "some.fmu")


def test_bounds_are_those_of_all_scalars() -> None:
    limits = ((-1.0, 2.0), (-3.0, 1.0), (0.0, 5.0), (0.0, 4.0))
    bounded = replace(variable("Float64", "float64"), limits=limits)
    assert (bounded.minimum, bounded.maximum) == (-3.0, 5.0)


def test_elements_are_counted_from_one_and_inside_a_derivative() -> None:
    assert element_names("x", ()) == ["x"]
    assert element_names("x", (2,)) == ["x[1]", "x[2]"]
    assert element_names("x", (2, 3))[3:] == ["x[2,1]", "x[2,2]", "x[2,3]"]
    assert element_names("der(x)", (2,)) == ["der(x[1])", "der(x[2])"]
    assert element_names("der(x)", ()) == ["der(x)"]


def packed(path: Path, *entries: tuple[str, bytes], link: str = "") -> Path:
    """An FMU with further entries, and one that is a symbolic link."""
    write(path.parent).rename(path)
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
        if link:
            entry = zipfile.ZipInfo(link)
            entry.external_attr = 0o120777 << 16
            archive.writestr(entry, "/etc/passwd")
    return path


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(
    ("entries", "link", "said"),
    [
        ([("modelDescription.xml", b"")], "", "its entry 'modelDescription.xml' is in it twice"),
        ([("resources/../../x", b"")], "", "its entry 'resources/../../x' leads out of its folder"),
        ([("..\\x", b"")], "", "leads out of its folder"),
        ([("/x", b"")], "", "its entry '/x' leads out of its folder"),
        ([("C:/x", b"")], "", "its entry 'C:/x' leads out of its folder"),
        ([], "resources/secret", "its entry 'resources/secret' is a link"),
        ([(f"resources/{i}", bytes(20 << 20)) for i in range(6)], "", "it would unpack to 126 MB, and may to"),
    ],
)
def test_archives_that_would_do_harm_are_refused(
    tmp_path: Path, entries: list[tuple[str, bytes]], link: str, said: str
) -> None:
    with pytest.raises(FmuError, match=re.escape(said)) as caught:
        FmuDescription(packed(tmp_path / "bad.fmu", *entries, link=link))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size", [1_000_001, 10**8, 1_250_000_000])
def test_a_variable_with_too_many_elements_is_refused(foreign_fmu_3: Path, tmp_path: Path, size: int) -> None:
    path = edited(foreign_fmu_3, tmp_path / "long.fmu", ('<Dimension start="7"/>', f'<Dimension start="{size}"/>'))
    with pytest.raises(FmuError, match=rf"imu.turn of long.fmu has {3 * size} elements, and may have 1000000 at most: export"):
        FmuDescription(path)


def test_an_element_far_away_makes_no_array(tmp_path: Path) -> None:
    far = [*VARIABLES[:-1], scalar("far[1250000000]", 90, 'causality="input"', '<Real start="0"/>'), VARIABLES[-1]]
    outputs, OUTPUTS[:] = list(OUTPUTS), [len(far)]
    try:
        assert "far" not in FmuDescription(write(tmp_path, variables=far))
    finally:
        OUTPUTS[:] = outputs
