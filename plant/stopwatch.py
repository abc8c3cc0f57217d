"""Reading the monotonic clock from compiled code, to know what each stage of a cycle takes."""

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from plant.compiled import kernel

CLOCK_MONOTONIC = 1

clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))


@kernel
def now(timespec: NDArray[np.int64]) -> int:
    """The monotonic clock [ns]; `timespec` (2,) is scratch."""
    clock_gettime(CLOCK_MONOTONIC, timespec.ctypes.data)
    return int(timespec[0] * 1_000_000_000 + timespec[1])
