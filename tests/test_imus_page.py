"""What docs/imus.md shows must be read, and its tables must be those of the source."""

import re
import shlex
import tomllib
from pathlib import Path

from hil.command_line import parse
from plant.imu.data_sheet import IMU_WORDS, SENSOR_WORDS
from plant.imu.presets import PRESETS, imu_of_table
from plant.imu_disturbances import WORDS, DisturbanceKind, disturbance, disturbance_of_table, disturbance_of_text

PAGE = (Path(__file__).parent.parent / "docs" / "imus.md").read_text()


def test_every_command_is_one_and_every_fault_is_read() -> None:
    commands = [shlex.split(line, comments=True)[1:] for line in re.findall(r"^gough .*$", PAGE, re.MULTILINE)]
    assert {words[0] for words in commands} == {"simulate", "inject", "emulate"}
    for words in commands:
        parse(words)
    faults = re.findall(r"\bimu-[a-z]+:[^\s`\"]+", PAGE)
    assert len(faults) > 15
    assert {disturbance_of_text(text).kind.name.lower() for text in faults} >= {"offset", "vibration", "turn", "stuck", "clock"}


def test_python_and_toml_say_the_same() -> None:
    python, toml = (re.findall(f"```{language}\n(.*?)```", PAGE, re.DOTALL) for language in ("python", "toml"))
    (table,) = tomllib.loads(toml[0])["disturbances"]
    line = next(line for line in python[0].splitlines() if line.startswith("disturbance("))
    assert eval(line, {"disturbance": disturbance}) == disturbance_of_table(table)
    model = imu_of_table(tomllib.loads(toml[1]), "mine", "the page")
    assert (model.sample_rate, model.accelerometer.order, model.conversion_rate) == (500.0, 2, 8000.0)
    part = imu_of_table(tomllib.loads(toml[2]), "part", "the page")
    preset = PRESETS["bmi088-calibrated"]
    assert (part.gyroscope.noise, part.accelerometer.noise) == (preset.gyroscope.noise, preset.accelerometer.noise)
    assert part.gyroscope.resolution == preset.gyroscope.resolution and part.gyroscope.drift > 0.0


def test_tables_are_those_of_the_source() -> None:
    for kind in DisturbanceKind:
        sizes = ", ".join(f"`{size}`" for size in kind.sizes) or "-"
        assert f"\n| `{kind.name.lower()}` | {sizes} | " in PAGE, kind
    for word in WORDS:
        assert f"`{word}`" in PAGE
    for word in (*SENSOR_WORDS, *IMU_WORDS):
        assert f"`{word}`" in PAGE or f"\n{word} = " in PAGE or f" {word} = " in PAGE, word
    for name in PRESETS:
        assert f"`{name}`" in PAGE
