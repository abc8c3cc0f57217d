"""Browsers that operate a run and end it, over real websockets; the channel is in a process of its own, beside a loop."""

import gc
import os
import signal
import threading
import time
import weakref
from contextlib import contextmanager

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from controller.frames import parse_frames  # noqa: E402
from controller.safety.causes import Cause  # noqa: E402
from hil.loop.records import Link, StopRequest  # noqa: E402
from hil.panel.access import close_server, open_server  # noqa: E402
from hil.panel.page import Page  # noqa: E402
from plant.pose import rotation_from_vector  # noqa: E402
from tests.hil.panel.browser import Browser, waited  # noqa: E402
from tests.hil.ports import free_port  # noqa: E402
from tests.hil.runs.test_operator import _loaded, begun, running  # noqa: E402, F401


@contextmanager
def served(address):
    """A server, and its page for the runs at an address, which shows none yet."""
    port = free_port()
    server = open_server("127.0.0.1", port, None)
    try:
        yield server, Page(server, address, None), port
    finally:
        close_server(server)


@contextmanager
def shown(page):
    """Let a page show runs; it goes on until the context ends."""
    over = threading.Event()
    thread = threading.Thread(target=page.run, args=(over,))
    thread.start()
    try:
        yield
        assert thread.is_alive()
    finally:
        over.set()
        thread.join(20.0)


@contextmanager
def operated(mechanism, browsers=1, **form):
    """A run, so many browsers at its page, and what tells its state."""
    with (
        running(mechanism, **form) as run, served(run.address) as (_, page, port), shown(page),
        run.operator(role="observer") as observer,
    ):  # fmt: skip
        begun(observer)
        opened = [Browser("127.0.0.1", port) for _ in range(browsers)]
        try:
            for browser in opened:
                waited(lambda browser=browser: browser.has("Step +"))
            yield run, opened, lambda: observer.ask("state")["telemetry"]
        finally:
            for browser in opened:
                browser.close()


def take_control(browser, number=0):
    browser.press("Take control")
    waited(lambda: browser.says(f"browser {number} operates the run"))


def rests_at(state, position):
    told = state()
    return not told["moving"] and np.abs(np.subtract(told["commanded"]["position"], position)).max() < 1e-8


@pytest.mark.slow
def test_a_button_that_a_browser_without_control_lets_go_does_not_end_anothers_jog(hexapod):
    button = "Hold to jog +"
    with operated(hexapod, 2) as (run, (first, second), state):
        take_control(first)
        began = time.monotonic()
        while (passed := time.monotonic() - began) < 2.2:
            first.hold(button)
            if 0.5 < passed < 0.8:
                second.hold(button)
                second.press(button)
            time.sleep(0.05)
            assert passed < 0.5 or state()["jogging"]
        # However often the button tells that it is held.
        assert second.notices == ["browser 0 operates the run: take control first"]
        first.press(button)
        waited(lambda: not state()["moving"])
        assert run.cause[0] == Cause.NONE and not first.notices


def test_any_browser_ends_the_run_at_once_though_another_program_operates_it(hexapod):
    with operated(hexapod) as (run, (browser,), _), run.operator(name="a program"):
        browser.press("Take control")
        waited(lambda: "a program operates this run" in "".join(browser.notices))
        browser.press("Controlled stop")
        waited(lambda: run.link[Link.STOP] == StopRequest.CONTROLLED)
        browser.press("Software quick stop")
        waited(lambda: run.link[Link.STOP] == StopRequest.QUICK)
        assert len(browser.notices) == 1


@pytest.mark.slow
def test_a_panel_leaves_the_processor_of_the_loop_to_it_until_the_run_has_ended(hexapod):
    everywhere = os.sched_getaffinity(0)
    kept = max(everywhere)
    with running(hexapod, processor=kept) as run, served(run.address) as (_, page, _), shown(page):
        waited(lambda: os.sched_getaffinity(0) == (everywhere - {kept} or everywhere) and page._live is not None)
        run.link[Link.DONE] = 1
        waited(lambda: page._live is None)
        assert os.sched_getaffinity(0) == everywhere


def test_the_end_of_a_run_waits_for_no_other_order(hexapod):
    over = threading.Event()
    with (
        running(hexapod) as run, served(run.address) as (server, page, port), shown(page),
        Browser("127.0.0.1", port) as browser,
    ):  # fmt: skip
        take_control(browser)
        # Its buttons are there before it is the one that is shown.
        waited(lambda: page._live is not None)
        page._live._orders.give(server.get_clients()[0], lambda operator: over.wait(30.0))
        browser.press("Software quick stop")
        waited(lambda: run.link[Link.STOP] == StopRequest.QUICK, 5.0)
        over.set()


def test_sliders_go_on_from_where_the_platform_rests_and_each_browser_has_numbers_of_its_own(hexapod):
    home = hexapod.home.position
    with operated(hexapod, 2) as (run, (first, second), state):
        take_control(first)
        first.enter("Axis", "z")
        first.enter("Step [mm, deg]", 55.0)
        second.enter("Axis", "y")
        second.enter("Step [mm, deg]", 2.0)
        first.press("Step +")
        waited(lambda: rests_at(state, home + [0.0, 0.0, 0.055]))
        # It has gone farther than the slider went.
        waited(lambda: first.value("z [mm]") == pytest.approx(55.0, abs=1e-5))
        assert second.value("z [mm]") == 0.0 and first.value("Step [mm, deg]") == 55.0
        for number in range(1, 31):
            first.enter("x [mm]", 0.1 * number)
            second.enter("y [mm]", 5.0 + 0.1 * number)
            time.sleep(0.01)
        waited(lambda: rests_at(state, home + [0.003, 0.0, 0.055]))
        assert second.notices and not first.notices and run.cause[0] == Cause.NONE
        # A goal that is refused is not where the slider stays.
        first.enter("y [mm]", 50.0)
        first.enter("z [mm]", -50.0)
        waited(lambda: first.notices)
        waited(lambda: rests_at(state, home + 1e-3 * np.array([first.value(f"{axis} [mm]") for axis in "xyz"])))
        positions, _ = run.check()
        assert np.ptp(positions[:, 2]) > 0.05


def test_sliders_and_places_are_in_the_frames_of_the_run(hexapod):
    text = "work = 'table'\ntool = 'tip'\n[frames.table]\nparent = 'base'\nposition = [0.0, 0.0, 0.3]\n"
    text += "rotation_vector_deg = [0.0, 0.0, 90.0]\n[frames.tip]\nparent = 'platform'\nposition = [0.0, 0.0, 0.1]\n"
    home, turned = hexapod.home.position, rotation_from_vector([0.0, 0.0, np.pi / 2.0])
    with operated(hexapod, frames=parse_frames(text, "here").active()) as (run, (browser,), state):
        take_control(browser)
        tip = turned.T @ (home + [0.0, 0.0, 0.1] - [0.0, 0.0, 0.3])
        np.testing.assert_allclose(browser.value("Place of tip in table [mm]"), 1e3 * tip, atol=1e-6)
        assert browser.says("displacements from home along table")
        browser.enter("x [mm]", 4.0)
        waited(lambda: rests_at(state, home + turned @ [0.004, 0.0, 0.0]))
        browser.press("Go to the place")
        waited(lambda: rests_at(state, home))
        waited(lambda: browser.value("x [mm]") == pytest.approx(0.0, abs=1e-5))
        assert not browser.notices and run.cause[0] == Cause.NONE


def test_a_wish_for_a_run_that_comes_too_late_is_dropped_and_told(hexapod):
    with running(hexapod) as run, served(run.address) as (server, page, port), Browser("127.0.0.1", port) as browser:
        waited(server.get_clients)
        # It listens, and does not answer yet.
        os.kill(run.channel.pid, signal.SIGSTOP)
        with shown(page):
            time.sleep(0.2)
            page.start(["--mechanism", "nothing"])
            os.kill(run.channel.pid, signal.SIGCONT)
            waited(lambda: browser.notices == [f"a run answers at {run.address} already: no other one was started"])
            waited(lambda: browser.has("Step +"))


def test_nothing_of_a_run_stays_when_the_page_shows_another(hexapod):
    with running(hexapod) as run, served(run.address) as (_, page, port), Browser("127.0.0.1", port) as browser:
        with shown(page):
            waited(lambda: browser.has("Step +"))
            before = weakref.ref(page._live._orders)
        waited(lambda: not browser.has("Step +"))
        with shown(page):
            waited(lambda: browser.has("Step +"))
            waited(lambda: gc.collect() is not None and before() is None)
