"""The extras of the installation: packages that only some users need."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from plant.errors import MissingPackageError

EXTRAS = {
    "SALib": "sweep",
    "can": "canopen",
    "canopen": "canopen",
    "control": "design",
    "dask": "sweep",
    "distributed": "sweep",
    "filterpy": "studies",
    "optuna": "sweep",
    "pandas": "notebook",
    "plotly": "reports",
    "pyarrow": "sweep",
    "scipy": "calibrate",
    "tomlkit": "studies",
    "viser": "panel",
    "vqf": "studies",
    "xarray": "notebook",
    "ziglang": "cross",
}
"""The extra that installs each package."""


def check_installed(package: str) -> None:
    """Check that a package of an extra is installed.

    Raises:
        MissingPackageError: it is not.
    """
    if find_spec(package) is None:
        raise _missing(package)


@contextmanager
def missing_extras_named() -> Iterator[None]:
    """Turn an import that fails for want of an extra into a `MissingPackageError`, which names that extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        raise _missing(package) from error


def _missing(package: str) -> MissingPackageError:
    return MissingPackageError(f"this needs {package}, which is not installed: pip install 'gough[{EXTRAS[package]}]'")
