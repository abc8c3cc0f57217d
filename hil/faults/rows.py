"""The rows of disturbances, from `rows.toml`, and what a seed makes of them."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from hil.rigs.emulation import FaultKind
from hil.runs.config import SimulationConfig
from plant.encoders import NO_LENGTHS
from plant.errors import InputError
from plant.files import check_entries, read_toml
from plant.fmu.settings import Setting
from plant.imu_disturbances import DisturbanceKind, disturbance_of_text
from plant.mechanism import LEGS, load_in_space

FILE = Path(__file__).with_name("rows.toml")
LINKS = ("fmu", "udp", "canopen")
"""Between the loop and its plant: nothing, or a bus in memory, on virtual time, with the emulated rig behind it."""

SOUND = "sound"
"""The kind of rows in which nothing is wrong."""

ENCODERS = "encoders"
"""The kind of rows with encoders."""

DRAWN = ("mechanism", "target", "imu", "rate", "joint_error")
"""What of a row a seed may draw."""

MOST_LATE = 5
"""A cycle that begins late does so by so many periods at most."""

MOST_GUILTY = 3
"""So many IMUs with the same disturbance are each at fault; what more of them share is not mended by leaving one out."""


@dataclass(frozen=True)
class Row:
    """A disturbance of the loop.

    Attributes:
        name, kind: in the table.
        faults: texts of `--fault`, or of `gough inject` behind a bus.
        settings: of the plant, texts of `--set`; what they name is there from the start, or at a time.
        mechanism, target, imu, rate, duration, joint_error: as in `SimulationConfig`.
        earliest, latest: bounds of the time at which it begins, after the motion has begun [s].
        base_bend_mm: how far the base plate is bent: its joints leave the plane by a saddle of this height [mm].
        joint_off_mm: how far base joint {k} is off, in a random direction [mm].
        link: one of `LINKS`.
        lengths, base_imu: the added sensors, as in `SimulationConfig`.
        late_percent: share of the cycles that begin one to `MOST_LATE` periods late, as on a busy machine [%].
        guilty: the IMUs that may rightly be left out; None for those that have a disturbance alone, or with a few others.
        sizes: bounds of {size}, which every seed draws on a logarithmic scale; none if there is nothing to draw.
        draw: lists by name; every seed draws a value of each. It stands for {name} in texts; one of `DRAWN` replaces the above.
    """

    name: str
    kind: str
    faults: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()
    mechanism: str = "hexapod"
    target: str = "sines"
    imu: str = "mpu9150-calibrated"
    rate: float = 1000.0
    duration: float = 20.0
    earliest: float = 2.0
    latest: float = 5.0
    joint_error: float = 0.0
    base_bend_mm: float = 0.0
    joint_off_mm: float = 0.0
    link: str = "fmu"
    lengths: str = NO_LENGTHS
    base_imu: bool = False
    late_percent: float = 0.0
    guilty: tuple[int, ...] | None = None
    sizes: tuple[float, ...] = ()
    draw: Mapping[str, Sequence[Any]] = field(default_factory=dict, hash=False)

    def with_entries(self, entries: Mapping[str, Any]) -> "Row":
        """The row with other entries, which then no seed draws; what it draws else stays the same."""
        draw = {name: [entries[name]] * len(choices) if name in entries else choices for name, choices in self.draw.items()}
        return replace(self, **entries, draw=draw)

    def drawn(self, seed: int, fusion: str) -> "Drawn":
        """What a seed makes of the row: IMUs, place, sign and time, and what else it draws."""
        random = np.random.default_rng([seed, crc32(self.name.encode())])
        at = round(self.earliest + (self.latest - self.earliest) * random.random(), 3)
        k, j, i = random.permutation(LEGS)[:3].tolist()
        values = {"k": k, "j": j, "i": i, "sign": "-" if random.random() < 0.5 else ""}
        values |= {"at": at} | {f"at{n}": round(at + n, 3) for n in (1, 2, 3)}
        if self.sizes:
            values["size"] = f"{np.exp(random.uniform(*np.log(self.sizes))):.3g}"
        chosen = {name: choices[int(random.integers(len(choices)))] for name, choices in self.draw.items()}
        values |= {name: str(choice).format_map(values) for name, choice in chosen.items()}
        of_row = replace(self, draw={}, **{name: choice for name, choice in chosen.items() if name in DRAWN})
        return of_row._run(values, at, random, seed, fusion)

    def _run(self, values: Mapping[str, Any], at: float, random: np.random.Generator, seed: int, fusion: str) -> "Drawn":
        texts = " ".join(self.faults).format_map(values).split()
        faults = tuple(text if re.search(r",at(_s)?=", text) else f"{text},at={at:g}" for text in texts)
        settings = [Setting.parse(text.format_map(values)) for text in self.settings]
        if self.base_bend_mm or self.joint_off_mm:
            settings.append(self._base_joints(values["k"], random))
        config = SimulationConfig(
            mechanism=self.mechanism, target=self.target, duration=self.duration, rate=self.rate, imu=self.imu, seed=seed,
            fusion=fusion, joint_error=self.joint_error, settings=tuple(settings), faults=faults if self.link == "fmu" else (),
            lengths=self.lengths, base_imu=self.base_imu,
        )  # fmt: skip
        guilty = guilty_of(faults) if self.guilty is None else frozenset(self.guilty)
        late = any(f"={at:g}" in text for text in faults) or any(each.at is not None for each in settings)
        return Drawn(config, self.link, faults, guilty, at if late else 0.0, self.late_percent)

    def _base_joints(self, k: int, random: np.random.Generator) -> Setting:
        """The true places of the base joints, of which the controller does not know."""
        joints = load_in_space(self.mechanism).base_joints.copy()
        angles = np.arctan2(joints[:, 1], joints[:, 0])
        joints[:, 2] += 1e-3 * self.base_bend_mm * np.cos(2.0 * angles)
        direction = random.standard_normal(3)
        joints[k] += 1e-3 * self.joint_off_mm * direction / np.linalg.norm(direction)
        return Setting("base_joints", tuple(joints.ravel().tolist()))


@dataclass(frozen=True)
class Drawn:
    """A row as a seed has it.

    Attributes:
        config: of the loop; the faults are in it if there is no bus.
        link: one of `LINKS`.
        faults: texts.
        guilty: the IMUs that may rightly be left out.
        begin: when the disturbance begins, after the hold or, behind a bus, after the drives were enabled [s].
        late_percent: as in `Row`.
    """

    config: SimulationConfig
    link: str
    faults: tuple[str, ...]
    guilty: frozenset[int]
    begin: float
    late_percent: float = 0.0

    @property
    def what(self) -> str:
        """The disturbance, and where it happens, in a line."""
        c = self.config
        settings = (each.text if len(each.value) <= 3 else each.name for each in c.settings)
        texts = " ".join([*self.faults, *settings]) or "nothing"
        texts += f" joint_error={c.joint_error:g}" if c.joint_error else ""
        return f"{texts} on {c.mechanism}, {c.target}, {c.imu}, {c.rate:g} Hz"


def guilty_of(faults: tuple[str, ...]) -> frozenset[int]:
    """The IMUs that are disturbed alone, or with at most `MOST_GUILTY` in all by the same text."""
    found: set[int] = set()
    disturbances = [kind.label for kind in DisturbanceKind]
    of_one = [kind.label for kind in FaultKind if kind.label.startswith("imu-")]
    for text in faults:
        name = text.partition(",")[0].partition(":")[0]
        if name in disturbances:
            imus = disturbance_of_text(text).imus
            found |= {*imus} if len(imus) <= MOST_GUILTY else set()
        elif name in of_one:
            found.add(int(text.partition(":")[2].partition(",")[0]))
    return frozenset(found)


@cache
def all_rows() -> tuple[Row, ...]:
    """Every row of `rows.toml`."""
    return rows_of(read_toml(FILE))


def rows_of(document: Mapping[str, Any]) -> tuple[Row, ...]:
    """The rows of a document.

    Raises:
        InputError: an entry is unknown, has a value of the wrong kind or out of range, or two rows have the same name.
    """
    rows = tuple(row for kind, entries in document.items() for entry in entries for row in _rows(kind, entry))
    for name, count in Counter(row.name for row in rows).items():
        if count > 1:
            raise InputError(f"{count} rows are called {name!r}: give each a name of its own")
    return rows


_KINDS = {each.name: each.default for each in fields(Row)}


class _Known(dict[str, Any]):
    """Values for texts, in which other names stay as they are."""

    def __missing__(self, key: str) -> str:
        return "{" + key + "}"


def _rows(kind: str, entry: Mapping[str, Any]) -> Iterator[Row]:
    check_entries(entry, [name for name in _KINDS if name != "kind"] + ["vary", "cross"], f"a row of [[{kind}]]")
    for values in (crossed | varied for crossed, varied in product(_points(entry, "cross"), _points(entry, "vary"))):
        own = {name: value for name, value in entry.items() if name not in ("vary", "cross")}
        own |= {name: value for name, value in values.items() if name in _KINDS}
        known = _Known(values)
        row = Row(kind=kind, **{name: _value(name, value, known) for name, value in own.items()})
        row = replace(row, name=row.name.format_map(known))
        if row.link not in LINKS:
            raise InputError(f"the row {row.name!r} has link = {row.link!r}; there are {', '.join(LINKS)}")
        if not 0.0 <= row.late_percent <= 100.0:
            raise InputError(f"the row {row.name!r} has late_percent = {row.late_percent:g}; it must be 0 to 100")
        if not 0.0 <= row.earliest <= row.latest < row.duration:
            raise InputError(
                f"the row {row.name!r} has earliest = {row.earliest:g} and latest = {row.latest:g}; its disturbance must begin "
                f"from 0 s on, and before the end of the motion: choose 0 <= earliest <= latest < duration = {row.duration:g}"
            )
        yield row


def _points(entry: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    """The values to take: those of a list of tables, or all combinations of a table of lists."""
    table = entry.get(name, [{}])
    if isinstance(table, list):
        return table
    return [dict(zip(table, values, strict=True)) for values in product(*table.values())]


def _value(name: str, value: Any, known: Mapping[str, Any]) -> Any:
    if name == "sizes":
        return _bounds(value)
    if name == "draw":
        return _choices(value, known)
    default = _KINDS[name]
    if name == "guilty" or default is MISSING:
        return tuple(value) if name == "guilty" else value
    if isinstance(default, tuple):
        return tuple(each.format_map(known) for each in value)
    filled = value.format_map(known) if isinstance(value, str) else value
    try:
        return type(default)(filled)
    except ValueError:
        raise InputError(f"{name} = {value!r} must be a {type(default).__name__}") from None


def _bounds(value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2 or not all(isinstance(each, int | float) for each in value):
        raise InputError(f"sizes = {value!r} must be two numbers, such as [0.1, 2]")
    least, most = value
    if not 0.0 < least <= most < np.inf:
        raise InputError(f"sizes = {value!r} must be above 0, the smaller one first, such as [0.1, 2]")
    return float(least), float(most)


def _choices(value: Any, known: Mapping[str, Any]) -> dict[str, list[Any]]:
    if not isinstance(value, dict):
        raise InputError(f"draw = {value!r} must be a table of lists, such as {{ rate = [250, 1000] }}")
    for name, choices in value.items():
        if not isinstance(choices, list) or not choices:
            raise InputError(f"draw.{name} = {choices!r} must be a list of values, such as [250, 1000]")
        if name in _KINDS and name not in DRAWN:
            raise InputError(f"draw.{name}: a seed cannot draw this entry; it can draw {', '.join(DRAWN)}")
    return {name: [_value(name, each, known) if name in DRAWN else each for each in value[name]] for name in value}
