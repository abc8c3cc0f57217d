"""Values for an FMU's parameters and inputs, as a user gives them."""

from dataclasses import dataclass
from math import inf, isfinite, nan

from plant.errors import InputError

_SWITCHES = {"true": 1.0, "false": 0.0}


@dataclass(frozen=True)
class Setting:
    """A value for a parameter or input of the FMU, from the start or from a later time."""

    name: str
    value: tuple[float, ...]  # one number for all elements, or one for each
    at: float | None = None  # [s]; None for the start

    @classmethod
    def parse(cls, text: str) -> "Setting":
        """Read text such as `payload.mass=12`, `gravity=0,0,-9.8` or `payload.mass=12@3.5`.

        Raises:
            InputError: the text is no setting.
        """
        name, equals, rest = text.partition("=")
        if not (name.strip() and equals):
            raise InputError(f"{text!r} is no setting such as payload.mass=12, gravity=0,0,-9.8 or payload.mass=12@3.5")
        value, at, time = rest.partition("@")
        numbers = tuple(map(_number, value.split(",")))
        if not all(map(isfinite, numbers)):
            raise InputError(
                f"{text!r} is no setting: {value!r} must be a finite number without a unit, such as 12, or one for each "
                "element, such as 0,0,-9.8"
            )
        seconds = _number(time) if at else None
        if seconds is not None and not 0.0 <= seconds < inf:
            raise InputError(f"{text!r} is no setting: {time!r} must be a time in seconds from 0 on, such as 3.5")
        return cls(name.strip(), numbers, seconds)

    @property
    def text(self) -> str:
        """The setting in the form that `parse` reads."""
        return f"{self.name}={','.join(f'{each:g}' for each in self.value)}" + ("" if self.at is None else f"@{self.at:g}")


def _number(text: str) -> float:
    """The number or switch of a text; NaN if it is none."""
    try:
        return float(_SWITCHES.get(text.strip(), text))
    except ValueError:
        return nan
