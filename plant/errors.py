"""The errors of gough: one hierarchy, in which each error is also a fitting builtin error.

Every message names the offending value, the limit that it breaks and the remedy.
"""


class GoughError(Exception):
    """Root of everything that gough raises on purpose."""


class InputError(GoughError, ValueError):
    """A value given by the user is malformed, out of range or not finite."""


class UnknownNameError(GoughError, LookupError):
    """A preset, motion or setting of that name does not exist."""


class SingularConfigurationError(GoughError, ArithmeticError):
    """The measurements do not determine the pose, or do not determine it uniquely."""


class UnreachableError(GoughError, ValueError):
    """A pose needs a leg outside its stroke."""


class CalibrationError(GoughError, ValueError):
    """The data cannot be explained, or do not determine the constants."""


class FmuError(GoughError, RuntimeError):
    """An FMU cannot be read, lacks something, or reported a failure of its own."""


class ToolchainError(GoughError, OSError):
    """Something that building needs, such as the C compiler, is missing or failed."""


class MissingPackageError(GoughError, ImportError):
    """A package that only some users need is not installed."""


class PlanningError(GoughError, RuntimeError):
    """The trajectory generator found no motion within the limits."""
