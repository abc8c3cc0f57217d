"""Trying FMUs: those that keep what they promise, and those that fail or crash."""

import re
import zipfile
from pathlib import Path

import pytest

from plant.errors import InputError
from plant.fmu.check import check_fmu, platforms_of
from tests.plant.fmu.foreign import edited


@pytest.mark.slow
@pytest.mark.parametrize("fixture", ["foreign_fmu", "foreign_fmu_3"])
def test_foreign_fmus_keep_their_promises(fixture: str, request: pytest.FixtureRequest) -> None:
    assert [check.problems for check in check_fmu(request.getfixturevalue(fixture))] == [(), (), (), None]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "finding"), [(3, "a step failed: servo 3 is at 91.5 degrees after a while"), (99, "crashed with signal 11")]
)
def test_a_failure_and_a_crash_are_findings(foreign_fmu: Path, tmp_path: Path, fault: int, finding: str) -> None:
    path = edited(foreign_fmu, tmp_path / "faulty.fmu", ('guid="{foreign}"', f'guid="{{fault {fault}}}"'))
    checks = check_fmu(path)
    assert [check.problems for check in checks[::3]] == [(), None]
    for check in checks[1:3]:
        assert check.problems is not None and len(check.problems) == 1
        assert re.search(finding, check.problems[0])


def test_platforms_are_the_folders_that_hold_binaries(tmp_path: Path) -> None:
    path = tmp_path / "many.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        for name in (
            "modelDescription.xml", "binaries/win64/a.dll", "binaries/linux64/a.so", "binaries/linux64/b.so", "binaries/empty/",
            "binaries/note.txt", "resources/darwin64/a.dylib",
        ):  # fmt: skip
            archive.writestr(name, b"")
    assert platforms_of(path) == ["linux64", "win64"]


@pytest.mark.slow
def test_a_trial_that_never_ends_is_ended_at_the_limit(foreign_fmu: Path, tmp_path: Path) -> None:
    path = edited(foreign_fmu, tmp_path / "hangs.fmu", ('guid="{foreign}"', 'guid="{fault 98}"'))
    checks = check_fmu(path, limit=3.0)
    assert [check.problems for check in checks] == [(), ("took longer than 3 s",), ("took longer than 3 s",), None]
    with pytest.raises(InputError, match="the limit is 0 s; it must be positive and finite"):
        check_fmu(path, limit=0.0)
