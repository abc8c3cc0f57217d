"""What make says while it installs, with a Python, a pip and a clock that only look like them."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PIP = "#!/bin/sh\n/bin/sleep 1\nexit {status}\n"
PYTHON = """#!/bin/sh
[ "$1" = -c ] && exit 0
mkdir -p .venv/bin && cp tools/pip .venv/bin/pip
"""
SLEEP = "#!/bin/sh\nexec /bin/sleep 0.15\n"


@pytest.mark.parametrize("status", [0, 3])
def test_a_line_tells_every_ten_seconds_that_installing_goes_on_and_a_failure_is_one(tmp_path, status):
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    tools = tmp_path / "tools"
    tools.mkdir()
    for name, script in {"pip": PIP.format(status=status), "python": PYTHON, "sleep": SLEEP}.items():
        (tools / name).write_text(script)
        (tools / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{tools}:{os.environ['PATH']}"}
    # It returns when nobody holds its output any more, the clock neither.
    made = subprocess.run(
        ["make", f"PYTHON={tools}/python", ".venv/installed"],
        cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60.0, check=False,
    )  # fmt: skip
    said = re.findall(r"^  still installing: (\d+) s$", made.stdout, re.MULTILINE)
    assert len(said) >= 2 and [int(each) for each in said] == [10 * (k + 1) for k in range(len(said))]
    assert made.stdout.index("Installing .[reports] into .venv, once") < made.stdout.index("still installing")
    assert (made.returncode == 0) == (tmp_path / ".venv" / "installed").exists() == (status == 0)
