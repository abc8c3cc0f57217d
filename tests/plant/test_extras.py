"""Packages that only some users need: one clear line where one is missing."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from plant.errors import GoughError, MissingPackageError
from plant.extras import EXTRAS, check_installed, missing_extras_named

ROOT = Path(__file__).parents[2]
DISTRIBUTIONS = {"can": "python-can"}


def without(package, code, *arguments, folder=None):
    """Run code in a process in which a package cannot be imported."""
    code = f"import sys; sys.modules[{package!r}] = None; {code}"
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=folder)


def test_each_package_is_in_its_extra_and_not_required_by_all():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = [each.partition(">")[0] for each in project["dependencies"]]
    for package, extra in EXTRAS.items():
        name = DISTRIBUTIONS.get(package, package)
        assert name in [each.partition(">")[0] for each in project["optional-dependencies"][extra]]
        assert name not in required
    (everything,) = project["optional-dependencies"]["all"]
    assert everything == f"gough[{','.join(sorted({*EXTRAS.values()} - {'cross'}))}]"


COMMANDS = {
    "can": ("run", "--rig", "canopen", "--duration", "1"),
    "control": ("tune",),
    "filterpy": ("simulate", "--fusion", "filterpy", "--duration", "0.1"),
    "plotly": ("simulate", "--duration", "0.1", "--report", "report.html"),
    "scipy": ("calibrate", "imu", "data.csv", "out.toml"),
    "vqf": ("compare-fusion", "--duration", "21"),
}


@pytest.mark.slow
@pytest.mark.parametrize("package", COMMANDS)
def test_a_command_names_the_extra_in_one_line(package, tmp_path):
    code = "from hil.command_line import main; sys.exit(main(sys.argv[1:]))"
    run = without(package, code, *COMMANDS[package], folder=tmp_path)
    assert run.returncode == 2
    assert run.stderr.splitlines()[-1] == (
        f"gough: this needs {package}, which is not installed: pip install 'gough[{EXTRAS[package]}]'"
    )
    assert list(tmp_path.iterdir()) == []


def test_python_gets_an_error_of_ours():
    run = without("plotly", "import hil; hil.write_report")
    assert "pip install 'gough[reports]'" in run.stderr.splitlines()[-1]
    assert issubclass(MissingPackageError, GoughError)
    assert issubclass(MissingPackageError, ImportError)


def test_a_module_of_ours_that_is_missing_is_no_extra():
    with pytest.raises(ModuleNotFoundError, match="no_such_module"), missing_extras_named():
        import no_such_module  # noqa: F401


def test_what_is_installed_is_not_complained_about():
    for package in EXTRAS:
        check_installed(package)


@pytest.mark.slow
def test_a_run_needs_no_extra():
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({list(EXTRAS)!r}));"
        "from hil import SimulationConfig, simulate; print(simulate(SimulationConfig(duration=0.05)).moved)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "True\n"
