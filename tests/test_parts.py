"""Parts of the tests, as CI runs one of three."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def collected(*options: str) -> list[str]:
    command = (sys.executable, "-m", "pytest", "--collect-only", "-p", "no:cacheprovider", "tests/hil/realtime", *options)
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300.0, check=False)
    return re.findall(r"^tests/hil/realtime/.*::.*$", listed.stdout, re.MULTILINE)


@pytest.mark.slow
def test_each_test_is_in_one_part() -> None:
    parts = [collected("--part", f"{part}/3") for part in (1, 2, 3)]
    assert all(parts) and len(set(map(tuple, parts))) == 3
    assert sorted(name for part in parts for name in part) == sorted(collected())


@pytest.mark.slow
def test_a_part_that_is_none_is_refused() -> None:
    assert not collected("--part", "4/3") and not collected("--part", "2")
