"""The panel in a real browser, at a real run with ideal IMUs, and at recordings."""

import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

from hil.look import leg_colors, stroke_shares
from hil.runs.operator import Operator
from hil.runs.operator_messages import ChannelError
from hil.runs.recorded_run import recorded_run
from tests.hil.ports import free_port

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [pytest.mark.slow(seconds=90), pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]

_FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
]  # fmt: skip
DESK, PHONE = {"width": 760, "height": 560}, {"width": 380, "height": 640}
"""Small, as software draws them."""


def started(*arguments):
    command = [sys.executable, "-m", "hil.command_line", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def state_of(address):
    with Operator(address, role="observer") as observer:
        return observer.ask("state")["telemetry"]


def waited(what, seconds=180.0):
    """What becomes true in time."""
    until = time.monotonic() + seconds
    while not (found := what()):
        assert time.monotonic() < until, "it takes too long"
        time.sleep(0.1)
    return found


@contextmanager
def ended(process):
    """At the end, the process ends as its user would end it."""
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


@contextmanager
def run(*arguments):
    """A run that is operated; yields the address of its channel."""
    address = f"127.0.0.1:{free_port()}"
    with ended(started(
        "run", "--target", f"operator:{address}", "--duration", "600", "--imu", "ideal", "--most-missed", "1000000",
        *arguments,
    )):  # fmt: skip

        def running():
            try:
                return state_of(address)["mode"] == "running"
            except ChannelError:
                return False

        waited(running, 300.0)
        yield address


@contextmanager
def panel(*arguments):
    """A panel; yields the address of its page."""
    port = free_port()
    with ended(started("panel", *arguments, "--listen", f"127.0.0.1:{port}", "--no-browser")) as process:
        line = process.stdout.readline()
        assert line == f"the panel is at http://127.0.0.1:{port}/\n", line + process.communicate()[0]
        yield f"http://127.0.0.1:{port}/"


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    """A browser that comes after others, which it would not do by itself as root: it draws without a graphics card."""
    modest = tmp_path_factory.mktemp("browser") / "chromium"
    without_right = "setpriv --bounding-set=-sys_nice --inh-caps=-sys_nice" if shutil.which("setpriv") else ""
    modest.write_text(f'#!/bin/sh\nexec nice -n 5 {without_right} "{CHROMIUM}" "$@"\n')
    modest.chmod(0o755)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=str(modest), args=_FLAGS)
        yield browser
        browser.close()


@contextmanager
def opened(browser, address, viewport=DESK):
    """A page; one that is left open would go on to draw."""
    page = browser.new_page(viewport=viewport)
    page.set_default_timeout(180_000)
    page.goto(address)
    yield page
    page.close()


def press(page, name):
    page.get_by_role("button", name=name, exact=True).click()


def colors_in(page, tmp_path):
    """The colours (n, 3) that the picture has left of the controls, and how many pixels each has."""
    from PIL import Image

    path = tmp_path / "page.png"
    page.screenshot(path=str(path))
    picture = np.asarray(Image.open(path).convert("RGB"))[150:, : page.viewport_size["width"] // 2]
    return np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)


def drawn(page, tmp_path):
    """How many colours the picture has left of the controls."""
    return len(colors_in(page, tmp_path)[0])


def has_colors(page, tmp_path, wanted):
    """Whether the picture has some pixels of about each of the colours (n, 3); the scene has a light of its own."""
    colors, counts = colors_in(page, tmp_path)
    off = np.abs(colors.astype(int)[:, None] - wanted.astype(int)).max(axis=2)
    return all(counts[near].sum() > 20 for near in (off < 24).T)


def test_a_browser_operates_a_run_and_a_second_one_does_not(chromium, tmp_path):
    """A panel that is closed leaves the run alone; any browser may end the run; the recording plays."""
    recording = tmp_path / "run.mcap"
    with run("--record", str(recording)) as address:
        with panel("--at", address) as page_address, opened(chromium, page_address) as page:
            take_control(page)
        with panel("--at", address) as page_address, opened(chromium, page_address) as page:
            assert waited(lambda: drawn(page, tmp_path) > 100)
            begin = state_of(address)["truth"]["position"]
            press(page, "Step +")
            page.get_by_text("take control first").wait_for()
            take_control(page)
            press(page, "Step +")
            waited(lambda: rests_at(address, begin, [1e-3, 0.0, 0.0]))
            with opened(chromium, page_address, PHONE) as second:
                second.get_by_text("browser 0 operates the run").wait_for()
                press(second, "Give up control (browser 0)")
                second.get_by_text("only one may").wait_for()
                press(second, "Step -")
                second.get_by_text("take control first").wait_for()
            assert rests_at(address, begin, [1e-3, 0.0, 0.0])
            jog_and_let_go(page, address)
            assert 1e-3 < state_of(address)["truth"]["position"][0] - begin[0] < 0.1
            follow_sliders(page)
            waited(lambda: rests_at(address, begin, [4e-3, -3e-3, 0.0]))
            page.get_by_role("tab", name="Go to").click()
            press(page, "Go to the point")
            waited(lambda: rests_at(address, begin, [0.0, 0.0, 0.0]))
            with opened(chromium, page_address, PHONE) as second:
                press(second, "Controlled stop")
                second.get_by_text("The run has ended").wait_for()
    play(chromium, recording, tmp_path)


def test_a_page_that_is_closed_while_it_jogs_ends_the_run_by_a_controlled_stop(chromium):
    """On a busy machine the button may count as released just before; then it is tried again."""
    with run() as address, panel("--at", address) as page_address, Operator(address, role="observer") as observer:

        def state():
            return observer.ask("state")["telemetry"]

        for number in range(4):
            with opened(chromium, page_address) as page:
                take_control(page, number)
                page.get_by_role("button", name="Hold to jog -", exact=True).hover()
                page.mouse.down()
                waited(lambda: state()["jogging"])
            waited(lambda: state()["stop"] or not state()["moving"])
            if state()["stop"]:
                break
        last = state()
        assert last["stop"] == "the operator has gone while the platform was jogged"
        stroke, lengths = np.array(observer.run["machine"]["stroke"]), np.array(last["lengths"])
        assert (lengths > stroke[:, 0]).all() and (lengths < stroke[:, 1]).all()


def test_a_recording_of_a_planar_mechanism_plays(chromium, tmp_path):
    recording = tmp_path / "run.mcap"
    process = started(
        "run", "--mechanism", "planar-3rpr", "--duration", "2", "--record", str(recording), "--most-missed", "1000000"
    )  # fmt: skip
    assert process.communicate(timeout=240)[0] and process.returncode == 0
    play(chromium, recording, tmp_path)


def test_a_page_without_a_run_starts_one_after_the_other(chromium, tmp_path):
    """A run that nobody moves is shown and can be ended; the next one is planar, and is moved."""
    address = f"127.0.0.1:{free_port()}"

    def running():
        try:
            return state_of(address)["mode"] == "running"
        except ChannelError:
            return False

    with panel("--at", address) as page_address, opened(chromium, page_address) as page:
        page.get_by_text(f"answers at {address}").wait_for()
        choose(page, "Target", "circle")
        press(page, "Start the run")
        waited(running, 300.0)
        page.get_by_text("hexapod follows circle").wait_for()
        assert waited(lambda: drawn(page, tmp_path) > 100)
        assert not page.get_by_role("button", name="Take control", exact=True).is_visible()
        page.get_by_role("tab", name="Limits").click()
        page.get_by_role("cell", name="conditioning of the Jacobian").wait_for()
        press(page, "Controlled stop")
        page.get_by_text("The run has ended").wait_for()
        # What was chosen before is still there.
        assert page.get_by_label("Target", exact=True).input_value() == "circle"
        choose(page, "Target", "operator")
        choose(page, "Mechanism", "planar-3rpr")
        choose(page, "IMUs", "ideal")
        press(page, "Start the run")
        waited(running, 300.0)
        begin = state_of(address)["truth"]["position"]
        take_control(page)
        press(page, "Go on")
        page.get_by_text("no move has been paused").wait_for()
        press(page, "Step +")
        waited(lambda: rests_at(address, begin, [1e-3, 0.0, 0.0]))
        assert page.locator("label", has_text="z [mm]").count() == 0
    waited(lambda: not running())


def choose(page, label, name):
    page.get_by_label(label, exact=True).click()
    page.get_by_role("option", name=name, exact=True).click()


def take_control(page, number=0):
    page.get_by_text("running", exact=True).wait_for()
    press(page, "Take control")
    page.get_by_text(f"browser {number} operates the run").wait_for()


def rests_at(address, begin, displacement):
    """Whether the plant rests there, to 0.2 mm."""
    state = state_of(address)
    return not state["moving"] and np.abs(np.subtract(state["truth"]["position"], begin) - displacement).max() < 2e-4


def jog_and_let_go(page, address):
    """A button that is held jogs until it is released, and the run goes on."""
    page.get_by_role("button", name="Hold to jog +", exact=True).hover()
    page.mouse.down()
    waited(lambda: state_of(address)["jogging"])
    page.mouse.up()
    waited(lambda: not state_of(address)["moving"])
    assert state_of(address)["mode"] == "running"


def follow_sliders(page):
    page.get_by_role("tab", name="Sliders").click()
    for number, value in enumerate(("4", "-3")):
        box = page.locator("input[type=text]:visible").nth(number)
        box.fill(value)
        box.press("Enter")


def play(chromium, recording, tmp_path):
    with panel(str(recording)) as page_address, opened(chromium, page_address) as page:
        page.get_by_text("Play", exact=True).click()
        assert waited(lambda: drawn(page, tmp_path) > 100)
        seek(page, "10000")
        page.get_by_text("controlled stop").first.wait_for()
        seek(page, "0.1")
        page.get_by_text("idle").wait_for()
        for name in ("estimate", "reference", "truth"):
            page.get_by_role("cell", name=name).wait_for()
        shown = recorded_run([recording])
        lengths = shown.records["lengths"][shown.at(0.1), : shown.mechanism.legs]
        legs = leg_colors(stroke_shares(lengths, shown.mechanism.require_limits().stroke))
        assert waited(lambda: has_colors(page, tmp_path, legs))


def seek(page, seconds):
    box = page.locator("input[type=text]:visible").first
    box.fill(seconds)
    box.press("Enter")
