"""What an FMU has logged, and what is said of an instance that failed or is closed."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from plant.errors import FmuError
from plant.fmu.instance import DISCARD, ERROR, OK, WARNING, FmuInstance


def instance() -> Any:
    return FmuInstance(SimpleNamespace(path=Path("some/any.fmu"), saves_state=True))  # type: ignore[arg-type]


def test_the_latest_hundred_messages_that_say_more_than_ok_are_kept_in_one_line_each() -> None:
    fmu = instance()
    for i in range(150):
        fmu._logged(None, ERROR, b"category", b"  message\n  %d " % i)
        fmu._logged(None, OK, b"category", b"all is well")
    assert list(fmu.messages) == [f"message {i}" for i in range(50, 150)]
    fmu._logged(None, WARNING, b"category", b"not \xff text")
    assert fmu.messages[-1] == "not \ufffd text"
    fmu._logged(None, WARNING, b"category", "\x1b[2J red \x9b31m".encode())
    assert fmu.messages[-1] == "\\x1b[2J red \\x9b31m"


@pytest.mark.parametrize(
    ("status", "ending"),
    [(WARNING, "gave a warning"), (DISCARD, "was discarded"), (ERROR, "failed"), (17, "ended with status 17")],
)
def test_a_failure_says_what_failed_how_and_the_last_reason(status: int, ending: str) -> None:
    fmu = instance()
    assert str(fmu._failed("a step", status)) == f"any.fmu: a step {ending}: the FMU gives no reason"
    assert fmu.status == status
    for reason in (b"first", b"last"):
        fmu._logged(None, ERROR, b"", reason)
    assert str(fmu._failed("a step", status)) == f"any.fmu: a step {ending}: last"


def test_a_closed_instance_is_used_no_more() -> None:
    fmu = instance()
    fmu.close()
    fmu.close()
    for use in (fmu.state, lambda: fmu.restore(b""), lambda: fmu.do_step(0.0, 1e-3), lambda: fmu.jacobian([], [])):
        with pytest.raises(FmuError, match=r"any\.fmu has been closed: load it again"):
            use()
