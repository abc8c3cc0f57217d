"""What docs/python.md shows must run, in its order, and pass strict type checks."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
SNIPPETS = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL)


def script(folder: Path, snippets: list[str]) -> Path:
    path = folder / "page.py"
    path.write_text("\n\n".join(snippets))
    return path


def run(folder: Path, *arguments: str) -> str:
    # BLAS would wait for its own threads.
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow(seconds=40)
def test_the_page_runs_as_one_script(tmp_path):
    printed = run(tmp_path, str(script(tmp_path, SNIPPETS)))
    assert "end of the motion" in printed and "icm42688" in printed
    errors = {float(gain): float(error) for gain, error in re.findall(r"^gain (\S+) (\S+)$", printed, re.MULTILINE)}
    assert 0.0 < errors[60.0] < 0.5 * errors[10.0] < 5e-3


@pytest.mark.slow
@pytest.mark.skipif(find_spec("mypy") is None, reason="mypy is for who changes gough")
def test_the_page_passes_strict_type_checks(tmp_path):
    # The page writes np.ndarray. An option would make mypy check all other files again; a comment in the file does not.
    run(ROOT, "-m", "mypy", "--strict", str(script(tmp_path, ['# mypy: disable-error-code="type-arg"', *SNIPPETS])))
