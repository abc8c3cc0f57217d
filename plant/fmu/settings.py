"""Values for an FMU's parameters and inputs, as a user gives them."""

from dataclasses import dataclass
from math import isfinite

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
        value, at, time = rest.partition("@")
        try:
            numbers = tuple(float(_SWITCHES.get(part.strip(), part)) for part in value.split(","))
            seconds = float(time) if at else None
        except ValueError:
            numbers, seconds = (), None
        finite = all(map(isfinite, numbers)) and (seconds is None or (isfinite(seconds) and seconds >= 0.0))
        if not (name.strip() and equals and numbers and finite):
            raise InputError(f"{text!r} is no setting such as payload.mass=12, gravity=0,0,-9.8 or payload.mass=12@3.5")
        return cls(name.strip(), numbers, seconds)

    @property
    def text(self) -> str:
        """The setting in the form that `parse` reads."""
        return f"{self.name}={','.join(f'{each:g}' for each in self.value)}" + ("" if self.at is None else f"@{self.at:g}")
