"""Who may open the panel, over real connections; and what a state becomes in words and colours."""

import http.client

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from websockets.datastructures import Headers  # noqa: E402

from controller.frames import ActiveFrames, Frames, parse_frames  # noqa: E402
from controller.workspace import Demands  # noqa: E402
from hil.command_line import main  # noqa: E402
from hil.loop.records import RECORD  # noqa: E402
from hil.panel import readings  # noqa: E402
from hil.panel.access import Gate, close_server, open_server, panel_address  # noqa: E402
from hil.panel.margins import margin_table  # noqa: E402
from hil.panel.readings import Readings, error_line, frames_to_choose, leg_table, pose_table, status_line  # noqa: E402
from hil.panel.scene import Machine, Scene  # noqa: E402
from hil.runs.telemetry import (  # noqa: E402
    frames_message,
    machine_message,
    margins_message,
    state_message,
    timing_message,
)
from plant.errors import InputError  # noqa: E402
from plant.pose import Pose  # noqa: E402
from tests.hil.ports import free_port  # noqa: E402

TOKEN = "0123456789abcdef0123"


@pytest.fixture(scope="module", params=[None, TOKEN], ids=["open", "token"])
def server(request):
    port = free_port()
    server = open_server("127.0.0.1", port, request.param)
    yield port, request.param
    close_server(server)


def answer(port, path="/", upgrade=False, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    headers = {name.replace("_", "-"): value for name, value in headers.items()}
    if upgrade:
        headers |= {
            "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol": f"viser-v{viser.__version__}",
        }  # fmt: skip
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    return response.status, response, "" if upgrade and response.status == 101 else response.read().decode(errors="replace")


@pytest.mark.parametrize("upgrade", [False, True])
def test_a_page_from_elsewhere_is_refused(server, upgrade):
    port, token = server
    path = "/" if token is None else f"/?token={token}"
    assert answer(port, path, upgrade)[0] == (101 if upgrade else 200)
    assert answer(port, path, upgrade, Origin=f"http://127.0.0.1:{port}")[0] == (101 if upgrade else 200)
    for origin in ("http://evil.example", f"http://127.0.0.1:{port + 1}", "null"):
        code, _, text = answer(port, path, upgrade, Origin=origin)
        assert code == 403 and (upgrade or "may not use this panel" in text)
    # Another name that leads here, as a page from elsewhere could have one made.
    code, _, text = answer(port, path, upgrade, Host=f"evil.example:{port}")
    assert code == 403 and "this panel is not at" in text


def test_without_the_token_nothing_is_served(server):
    port, token = server
    if token is None:
        return
    for path in ("/", "/?token=wrong", "/?token=", "/index.html"):
        for upgrade in (False, True):
            code, _, text = answer(port, path, upgrade)
            assert code == 403 and "the token is missing or wrong" in text
    code, response, _ = answer(port, f"/?token={token}")
    assert code == 200
    cookie = response.getheader("Set-Cookie")
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    kept = cookie.partition(";")[0]
    assert answer(port, "/", Cookie=kept)[0] == 200 and answer(port, "/", True, Cookie=kept)[0] == 101
    assert answer(port, "/", Cookie="gough_panel=wrong")[0] == 403
    assert answer(port, "/?token=wrong", Cookie="other=1")[0] == 403


def test_no_other_page_shows_it_in_a_frame(server):
    port, token = server
    _, response, _ = answer(port, "/" if token is None else f"/?token={token}")
    assert response.getheader("X-Frame-Options") == "DENY"


def test_a_panel_that_listens_everywhere_is_known_by_any_name_and_needs_its_token():
    gate = Gate("0.0.0.0", TOKEN)
    headers = Headers({"Host": "lab-pc:8080", "Origin": "http://lab-pc:8080"})
    assert "token is missing" in gate.refusal(headers, "/") and not gate.refusal(headers, f"/?token={TOKEN}")
    with pytest.raises(InputError, match=r"--page-token-file FILE, or listen at 127\.0\.0\.1:8080"):
        panel_address("0.0.0.0:8080", None)
    assert panel_address("0.0.0.0:8080", TOKEN) == ("0.0.0.0", 8080)


def test_an_address_that_is_taken_is_refused(server):
    with pytest.raises(InputError, match="choose another --listen"):
        open_server("127.0.0.1", server[0], None)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nothing.mcap"], "nothing.mcap"),
        (["run.mcap", "--start", "--imu", "ideal"], "play a recording, or start a run with --start, and not both"),
        (["--listen", "192.168.1.1:80"], "--page-token-file"),
    ],
)
def test_what_a_panel_cannot_show_is_told_in_a_line(arguments, text, capsys):
    assert main(["panel", *arguments, "--no-browser"]) != 0
    told = capsys.readouterr().err.strip()
    assert text in told and "\n" not in told


@pytest.fixture
def machine(hexapod):
    return Machine.of_message(machine_message(hexapod))


def table_of(*shown):
    """The table without the spaces that keep its columns apart."""
    return pose_table(*shown).replace("\u2003", "")


def test_colours_show_stroke_speed_or_imu(machine):
    middle, end = machine.stroke.mean(axis=1), machine.stroke[:, 1]
    state = {"lengths": np.where(np.arange(6) < 3, middle, end), "rates": np.full(6, machine.velocity), "imus": [0, 2]}
    np.testing.assert_allclose(machine.shares(state, "stroke"), [0, 0, 0, 1, 1, 1], atol=1e-12)
    np.testing.assert_allclose(machine.shares(state, "speed"), 1.0)
    np.testing.assert_array_equal(machine.shares(state, "IMUs"), [0, 1, 0, 1, 1, 1])


def test_a_record_becomes_a_state_and_words(hexapod, machine):
    records = np.zeros(3, RECORD)
    record = records[2]
    record["position"], record["rotation"], record["lengths"] = [0.001, -0.002, 0.35], np.eye(3), 0.4
    record["truth"], record["imus"], record["protection"] = np.nan, 0b1011111, [1.5e-3, np.inf]
    records["stage_ns"], records["late_ns"], records["missed"] = 1000, 2000, [0, 1, 1]
    frames = ActiveFrames(Frames())
    state = state_message(record, frames)
    assert state["imus"] == [0, 1, 2, 3, 4, 6] and "truth" not in state
    assert "| estimate | 1.00 | -2.00 | 350.00 | 0.000 | 0.000 | 0.000 |" in table_of(state)
    assert "protection level 1.50 mm, inf deg" in error_line(state)
    rows = leg_table(state, machine).splitlines()
    assert rows[7].endswith("| **out** |") and rows[2].endswith("| used |")
    assert status_line(state).startswith("**idle**")
    timing = timing_message(records, np.arange(3), 1e-3)
    assert timing["late"] == pytest.approx(2e-6) and timing["missed"] == 2
    assert timing_message(records, np.arange(0), 1e-3) == {}
    record["position"] = np.nan
    assert "pose" not in state_message(record, frames)
    assert table_of(state_message(record, frames)) == "no pose"


def test_poses_are_told_in_any_frame_of_the_run_on_the_base(hexapod):
    text = "work = 'table'\ntool = 'tip'\n[frames.table]\nparent = 'base'\nposition = [0.0, 0.0, 0.3]\n"
    text += "[frames.tip]\nparent = 'platform'\nposition = [0.0, 0.0, 0.1]\n[frames.sea]\nparent = 'level'\n"
    frames = parse_frames(text, "here").active()
    choices = frames_to_choose(frames_message(frames))
    assert list(choices) == ["tip in table", "platform in table", "tip in base", "platform in base"]
    state = {"pose": {"position": [0.01, 0.0, 0.35], "rotation": [0.0, 0.0, 0.1]}}
    assert "| estimate | 10.00 | 0.00 | 150.00 | 0.000 | 0.000 | 5.730 |" in table_of(state, choices["tip in table"])
    assert "| estimate | 10.00 | 0.00 | 50.00 |" in table_of(state, choices["platform in table"])
    assert "| estimate | 10.00 | 0.00 | 350.00 |" in table_of(state, choices["platform in base"])
    assert list(frames_to_choose(frames_message(ActiveFrames(Frames())))) == ["platform in base"]


def test_margins_of_all_limits_come_the_closest_first(hexapod):
    stroke = hexapod.limits.stroke[:, 1].max()
    high = Pose(hexapod.home.position + [0.0, 0.0, 0.06], hexapod.home.rotation)
    told = margins_message(hexapod, high, Demands())
    assert told[0]["kind"] == "stroke" and 0.0 < told[0]["share"] < 0.2 and told[0]["bound"] == pytest.approx(stroke)
    assert [each["share"] for each in told] == sorted(each["share"] for each in told)
    assert {each["kind"] for each in told} >= {"stroke", "force", "Jacobian", "direct kinematics"}
    rows = margin_table(told).splitlines()
    assert rows[2].startswith("| stroke of leg ") and f"| {1e3 * stroke:.4g} mm |" in rows[2] and len(rows) == 2 + len(told)
    assert margin_table([]) == "no pose"
    beyond = Pose(hexapod.home.position + [0.0, 0.0, 0.08], hexapod.home.rotation)
    assert "| **-" in margin_table(margins_message(hexapod, beyond, Demands()))


def test_texts_wait_for_their_turn_and_the_last_ones_do_not(machine, monkeypatch):
    monkeypatch.setattr(readings, "_TEXT_S", 60.0)
    server = open_server("127.0.0.1", free_port(), None)
    try:
        status = server.gui.add_markdown("")
        shown = Readings(server, machine, Scene(server, machine), frames_message(ActiveFrames(Frames())), status)
        for mode, at_once, said in (("running", False, "running"), ("fault", False, "running"), ("stopped", True, "stopped")):
            shown.show({"mode": mode}, [], at_once)
            assert status.content.startswith(f"**{said}**")
    finally:
        close_server(server)
