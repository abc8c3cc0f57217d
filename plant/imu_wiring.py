"""How the seven IMUs are mounted and wired."""

import re
from collections.abc import Collection
from dataclasses import dataclass

from plant.errors import InputError

IMU_COUNT = 7
PLATFORM_IMU = 6
"""Row of the platform's IMU in arrays over the seven IMUs; rows 0 to 5 are the legs'."""

ALL_IMUS = tuple(range(IMU_COUNT))

BASE_IMU = 7
"""Number of the IMU on the base, where there is one."""

SLOTS = BASE_IMU + 1

RIGHT_AXES = "+x+y+z"


def require_imus(imus: Collection[int], base_imu: bool, title: str) -> None:
    """Check that the IMUs which `title` is for are there. What is for all is for those that there are.

    Raises:
        InputError: it is for the base's, and there is none.
    """
    if not base_imu and BASE_IMU in imus and len(imus) < SLOTS:
        raise InputError(
            f"{title} is for IMU {BASE_IMU}, on the base, and there is none: name one of 0 to {PLATFORM_IMU}, or add --base-imu"
        )


@dataclass(frozen=True)
class Wiring:
    """How seven IMUs are mounted and wired; by default correctly.

    Attributes:
        places: where each IMU sits, 0-5 on the legs and 6 on the platform.
        gyroscopes, accelerometers: what each reads for its x, y and z, such as "+y-x+z"; 0 for nothing.
    """

    places: tuple[int, ...] = ALL_IMUS
    gyroscopes: tuple[str, ...] = (RIGHT_AXES,) * IMU_COUNT
    accelerometers: tuple[str, ...] = (RIGHT_AXES,) * IMU_COUNT

    def __post_init__(self) -> None:
        if sorted(self.places) != list(ALL_IMUS):
            raise InputError(f"the IMUs' places are {self.places}; they must be 0 to {IMU_COUNT - 1} in some order")
        if {len(self.gyroscopes), len(self.accelerometers)} != {IMU_COUNT}:
            raise InputError(f"a wiring has axes of {IMU_COUNT} gyroscopes and {IMU_COUNT} accelerometers")
        for axes in (*self.gyroscopes, *self.accelerometers):
            if not re.fullmatch("([+-][xyz]|0){3}", axes):
                raise InputError(f"there are no axes {axes!r}; give three such as +y-x+z, 0 for one that reads nothing")


RIGHT_WIRING = Wiring()
