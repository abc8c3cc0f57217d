"""What the pages show must be read and must run, and as they are built they must need nothing from outside."""

import os
import re
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controller.inverse_kinematics import inverse_kinematics
from hil.command_line import COMMANDS, main, parse
from hil.reference import PARTS
from plant.mechanism import load_mechanism

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = {path.name: path.read_text() for path in (*sorted(DOCS.glob("*.md")), ROOT / "README.md", ROOT / "CONTRIBUTING.md")}

RUN_BY = {
    "README.md": "test_readme.py",
    "compare.md": "test_compare_page.py",
    "fmu.md": "test_docs.py",
    "frames.md": "test_frames_page.py",
    "imus.md": "test_imus_page.py",
    "motions.md": "test_motions_page.py",
    "operating.md": "test_operating_page.py",
    "optimisation.md": "test_optimisation_page.py",
    "python.md": "test_python_page.py",
    "sweeps.md": "test_sweeps_page.py",
    "tuning.md": "test_tuning_page.py",
    "workspace.md": "test_workspace_page.py",
}
"""The tests that run the Python of a page; this one runs that of the others."""

AS_A_SCRIPT = {"python.md": "test_python_page.py"}
"""The tests that run all Python of a page as one script."""

OF_A_PROCESS = ("panel", "jog", "move")
"""Commands that wait for a browser or another process; other tests run them."""


def blocks(page: str, language: str = r"\w*") -> list[str]:
    return re.findall(rf"^```(?:{language})\n(.*?)^```", PAGES[page], re.DOTALL | re.MULTILINE)


def commands(page: str) -> list[list[str]]:
    lines = "\n".join(blocks(page)).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("gough ")]


def run_python(page: str, **names: Any) -> dict[str, Any]:
    (code,) = blocks(page, "python")
    exec(compile(code, page, "exec"), names)
    return names


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)])
def test_every_command_of_a_page_is_one(page: str) -> None:
    for words in commands(page):
        parse(words)


def test_commands_are_found_on_many_pages() -> None:
    assert sum(len(commands(page)) for page in PAGES) > 200


def test_the_python_of_every_page_is_run_by_a_test() -> None:
    here = Path(__file__).read_text()
    for page in PAGES:
        if not blocks(page, "python"):
            assert page not in RUN_BY, page
        elif page in AS_A_SCRIPT:
            source = (ROOT / "tests" / AS_A_SCRIPT[page]).read_text()
            assert f'"{page}"' in source and "sys.executable" in source and "SNIPPETS" in source, page
        elif page in RUN_BY:
            source = (ROOT / "tests" / RUN_BY[page]).read_text()
            assert f'"{page}"' in source and re.search(r"\b(exec|eval|runpy\.run_path)\(|\bsys\.executable\b", source), page
        else:
            assert re.search(rf'run_python\(\s*"{page}"', here), page


def test_the_equation_of_a_leg_holds() -> None:
    assert run_python("concepts.md")["legs"].directions.shape == (6, 3)


def test_the_calls_of_direct_kinematics_find_the_pose() -> None:
    """On a mechanism two of whose legs meet in a joint of the platform, as the paper's section 4 needs."""
    mechanism = load_mechanism("6-5")
    pose = mechanism.require_home()
    directions = inverse_kinematics(mechanism, pose).directions
    names = run_python(
        "direct_kinematics.md", mechanism=mechanism, leg_directions=directions, vertical=pose.rotation[2],
        normal=pose.rotation[:, 2], many_directions=np.tile(directions, (3, 1, 1)), many=np.tile(pose.rotation[2], (3, 1)),
    )  # fmt: skip
    assert abs(names["solve"](mechanism, directions).position - pose.position).max() < 1e-12


def run_in(folder: Path, words: list[str]) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", "hil.command_line", *words],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=300.0, check=False,
    )  # fmt: skip
    assert done.returncode == 0, (words, done.stdout, done.stderr)


@pytest.mark.slow(seconds=60)
def test_a_newcomer_gets_through_the_first_ten_minutes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The commands of docs/start.md work in their order; what they record is read as docs/real_time.md says."""
    monkeypatch.chdir(tmp_path)
    (toml,) = blocks("start.md", "toml")
    (tmp_path / "mine.toml").write_text(toml)
    tried = [words for words in commands("start.md") if words[0] not in OF_A_PROCESS and "operator" not in words]
    assert [words[0] for words in tried] == [*["simulate"] * 5, "classify", "workspace", "simulate", "motion", "run", "replay"]
    for words in tried:
        if words[0] == "run":
            # A busy machine misses periods, of which this is no test.
            run_in(tmp_path, [*words, "--most-missed", "10000"])
        else:
            assert main(words) == 0, words
    assert "IMU 3 is left out: the others contradict it" in capsys.readouterr().out
    assert (tmp_path / "run.html").stat().st_size > 1e6
    assert len(run_python("real_time.md")["records"]) > 1000


@pytest.mark.slow
@pytest.mark.parametrize("page", ["concepts.md", "fusion.md"])
def test_the_commands_of_the_concepts_work(page: str) -> None:
    for words in commands(page):
        assert main(words) == 0, words


def test_every_page_is_in_the_table_of_contents_once() -> None:
    named = [line for block in blocks("index.md", r"\{toctree\}") for line in block.splitlines() if re.fullmatch(r"\w+", line)]
    assert sorted(named) == sorted({name.removesuffix(".md") for name in PAGES} - {"index", "README", "CONTRIBUTING"})


def test_every_part_of_the_reference_is_on_a_page() -> None:
    named = [name for page in PAGES.values() for name in re.findall(r"^<!-- reference: (\w+) -->$", page, re.MULTILINE)]
    assert sorted(named) == sorted(PARTS)


def test_the_reference_has_every_command_and_option() -> None:
    text = PARTS["commands"]()
    for names in COMMANDS.values():
        for name in names:
            assert f"### `gough {name}`\n" in text
    assert "| `--joint-error JOINT_ERROR` | mm | 0 | simulated: standard deviation" in text
    assert "#### `gough frames set`" in text


class _Loaded(HTMLParser):
    """What a browser would load with a page; links that a reader follows are none."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.found += [value for name in ("src", "srcset", "data", "poster") if (value := given.get(name))]
        if tag == "link" and given.get("rel") not in ("index", "search", "next", "prev", "canonical"):
            self.found.append(given.get("href") or "")


def built_pages(folder: Path) -> Path:
    """The pages as `make docs` builds them; CI has just done so, and says where they are."""
    if there := os.environ.get("GOUGH_BUILT_PAGES"):
        return Path(there)
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-n", "-W", "--keep-going", "-q", "-d", folder / "cache", DOCS, folder / "html"],
        env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=600.0, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    return folder / "html"


@pytest.mark.slow(seconds=60)
def test_the_pages_are_built_without_a_warning_and_need_nothing_from_outside(tmp_path: Path) -> None:
    html = built_pages(tmp_path)
    pages = {path.stem: path.read_text() for path in html.glob("*.html")}
    assert pages.keys() >= {name.removesuffix(".md") for name in PAGES} - {"README", "CONTRIBUTING"}
    remote = re.compile(r"^(?:[a-z]+:)?//")
    for name, page in pages.items():
        loaded = _Loaded()
        loaded.feed(page)
        assert loaded.found and not [each for each in loaded.found if remote.match(each)], name
        assert not re.search(r"url\(\s*['\"]?(?:https?:)?//|@import", page), name
    for sheet in html.rglob("*.css"):
        assert not re.search(r"url\(\s*['\"]?(?:https?:)?//|@import", sheet.read_text()), sheet
    for script in (html / "_static").rglob("*.js"):
        assert not re.search(r"(?:import|fetch|importScripts)\(?\s*['\"](?:https?:)?//", script.read_text()), script
    for picture in html.rglob("*.svg"):
        assert not re.search(r"(?:href|src)\s*=\s*['\"](?:https?:)?//|url\(\s*['\"]?(?:https?:)?//", picture.read_text()), (
            picture
        )
    assert pages["concepts"].count("<math ") > 30
    assert "<code" in pages["files"] and "need_platform_imu" in pages["files"] and "<!-- reference" not in pages["files"]
    assert 'id="hil.SimulationConfig"' in pages["python_reference"]
