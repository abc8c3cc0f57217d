"""What docs/optimisation.md shows in Python must run."""

import contextlib
import re
import runpy
from pathlib import Path

import pytest

PAGE = (Path(__file__).parent.parent / "docs" / "optimisation.md").read_text()
EXAMPLES = dict(re.findall(r"<!-- example: (\S+) -->\n```\w+\n(.*?)```", PAGE, re.DOTALL))


@pytest.mark.slow
def test_the_example_finds_a_better_design_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, text in EXAMPLES.items():
        (tmp_path / name).write_text(text)
    with contextlib.chdir(tmp_path):
        first, again = (runpy.run_path("search.py", run_name="__main__")["result"] for _ in range(2))
    assert capsys.readouterr().out.count("as it was: {'tracking.position_rms':") == 2
    assert len(first.trials) == 8 and first.front == (first.knee,)
    assert first.knee.figures["tracking.position_rms"] == min(each.figures["tracking.position_rms"] for each in first.trials)
    assert first.knee.figures["tracking.position_rms"] < first.start["tracking.position_rms"]
    assert (again.ran, again.trials) == (0, first.trials)
