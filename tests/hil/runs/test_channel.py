"""The channel of a run that nobody moves: it may be watched and ended, and has no part in the loop."""

import json
import socket
import time
from contextlib import contextmanager, suppress

import numpy as np
import psutil
import pytest

from controller.safety.causes import Mode
from hil.loop.records import LINK_SIZE, RECORD, Link, StopRequest, shared_array
from hil.recording.mcap import read
from hil.recording.replay import replay
from hil.runs.channel_process import channel_process
from hil.runs.config import OPERATOR_CHANNEL, SimulationConfig
from hil.runs.operator import Operator, RequestRefusedError
from hil.runs.operator_messages import ChannelError
from plant.errors import InputError
from plant.mechanism import load_in_space
from tests.hil.ports import free_port
from tests.hil.runs.test_operated_run import command, ready

TOKEN = "0123456789abcdef0123"


class Beside:
    """A channel beside a loop that has not begun; its memory is in `link`."""

    def __init__(self, **changes):
        self.config = SimulationConfig(**{"channel": f"127.0.0.1:{free_port()}", **changes})
        self.link, self.records = shared_array(LINK_SIZE, np.dtype(np.int64)), shared_array(8, RECORD)
        self.said = []

    @contextmanager
    def served(self):
        with channel_process(self.config, self.records, self.link, None, self.said.append, 3) as self.process:
            yield self


def test_all_may_watch_and_end_the_run_but_nobody_may_move_it():
    with Beside(target="sines").served() as run, Operator(run.config.channel, role="observer") as observer:
        assert observer.run["target"] == "sines" and not observer.run["operated"]
        assert observer.ask("state")["telemetry"]["mode"] == "preparing"
        for order in ("move", "stop"):
            with pytest.raises(RequestRefusedError, match="an observer gives no orders"):
                observer.ask(order)
        with Operator(run.config.channel) as operator:
            for order in ("move", "follow", "step", "jog", "beat", "stop", "pause", "resume"):
                with pytest.raises(RequestRefusedError, match="follows sines: only one with --target operator") as refused:
                    operator.ask(order, to="home")
                assert refused.value.kind == "refused"
            assert run.link[Link.STOP] == 0
            observer.end()
            assert run.link[Link.STOP] == StopRequest.CONTROLLED
            operator.emergency()
            assert run.link[Link.STOP] == StopRequest.QUICK
        observer.watch()
        run.link[Link.DONE] = 1
        with pytest.raises(ChannelError, match="the run has ended"):
            observer.listen(5.0)
        assert observer.events[-1]["event"] == "the run has ended"


def test_clients_on_its_machine_are_told_which_processor_the_loop_keeps(tmp_path):
    (tmp_path / "token").write_text(TOKEN)
    port = free_port()
    with Beside(channel=f"0.0.0.0:{port}", token_file=str(tmp_path / "token")).served():
        for address, processor in (("127.0.0.1", 3), ("127.0.0.2", None)):
            # The second comes from 127.0.0.1, as one from another machine has another address than the run.
            with Operator(f"{address}:{port}", TOKEN, role="observer") as observer:
                assert observer.run["processor"] == processor


def test_a_run_that_ends_while_clients_are_there_prints_nothing(capfd):
    """One that watches, one that operates, and one that has said nothing yet."""
    with Beside().served() as run:
        host, port = run.config.channel.split(":")
        with (
            Operator(run.config.channel, role="observer") as observer,
            Operator(run.config.channel),
            socket.create_connection((host, int(port))),
        ):
            observer.watch()
            run.link[Link.DONE] = 1
            run.process.join(10.0)
            assert run.process.exitcode == 0
    assert capfd.readouterr().err == ""


def test_a_taken_address_is_a_remark_by_default_and_an_error_where_it_was_asked_for():
    with socket.socket() as other:
        # Another run may have it already.
        with suppress(OSError):
            other.bind(("127.0.0.1", 47300))
            other.listen()
        with Beside(channel=None).served() as run:
            assert run.process is None
        assert f"no channel, as {OPERATOR_CHANNEL} is taken" in run.said[0]
        for changes in ({"channel": OPERATOR_CHANNEL}, {"channel": None, "target": "operator"}):
            with pytest.raises(ChannelError, match="cannot listen for clients"), Beside(**changes).served():
                pass
        with Beside(channel="none").served() as run:
            assert run.process is None and not run.said


def test_a_channel_beyond_this_machine_needs_a_token_and_words_that_contradict_are_refused(tmp_path):
    with (
        pytest.raises(InputError, match="would take orders from other machines: give a token"),
        Beside(channel="192.168.1.5:47300").served(),
    ):
        pass
    (tmp_path / "token").write_text(TOKEN)
    with Beside(token_file=str(tmp_path / "token")).served() as run:
        with pytest.raises(ChannelError, match="the token is wrong"):
            Operator(run.config.channel, role="observer")
        Operator(run.config.channel, TOKEN, role="observer").close()
    for changes, said in (
        ({"channel": "none", "target": "operator"}, "--channel is none, but an operator moves the platform"),
        ({"channel": "none", "token_file": "token"}, "--channel is none, but --token-file gives its token"),
        ({"channel": "127.0.0.1:1", "target": "operator:127.0.0.1:2"}, "both say where the channel is"),
    ):
        with pytest.raises(InputError, match=said):
            SimulationConfig(**changes)


@pytest.mark.slow(seconds=60)
@pytest.mark.parametrize("mechanism", ["hexapod", "planar-3rpr"])
def test_a_run_that_follows_a_circle_is_watched_and_ended_and_replays(tmp_path, mechanism):
    address, period = f"127.0.0.1:{free_port()}", 2e-3
    run = command(
        "run", "--mechanism", mechanism, "--channel", address, "--duration", 120, "--rate", 500, "--most-missed", 2000,
        "--record", tmp_path / "run.mcap", "--json", tmp_path / "run.json",
    )  # fmt: skip
    try:
        ready(run, address)
        # One process alone has the socket, and it is not the loop's; with nobody there it does nothing.
        family = psutil.Process(run.pid).children(recursive=True)
        port = int(address.rpartition(":")[2])
        (channel,) = (each for each in family if any(link.laddr.port == port for link in each.net_connections()))
        assert len(family) >= 3 and not psutil.Process(run.pid).net_connections()
        before, began = channel.cpu_times(), time.monotonic()
        time.sleep(3.0)
        after = channel.cpu_times()
        used = after.user + after.system - before.user - before.system
        assert used < 0.02 * (time.monotonic() - began) + 0.01
        with Operator(address, role="observer") as observer:
            observer.watch()
            told = []
            until = time.monotonic() + 20.0
            while len(told) < 20:
                assert time.monotonic() < until
                observer.listen(0.2)
                # A busy machine may take longer until the first comes.
                told += [observer.telemetry] if observer.telemetry else []
            home = load_in_space(mechanism).home.position
            assert observer.run["machine"]["planar"] == (mechanism == "planar-3rpr")
            for state in told:
                assert state["mode"] == "running" and state["timing"]["period"] == period
                np.testing.assert_allclose(state["commanded"]["position"], state["truth"]["position"], atol=3e-3)
            ways = np.array([state["commanded"]["position"] for state in told]) - home
            assert np.ptp(ways, axis=0).max() > 1e-3
            if mechanism == "hexapod":
                with Operator(address) as operator:
                    operator.end()
            else:
                # Nobody needs the channel for the run to go on, and to end by a signal.
                channel.kill()
                time.sleep(1.0)
                assert run.poll() is None
                run.terminate()
        assert run.wait(60.0) == 0, run.communicate()
    finally:
        run.kill()
        run.communicate()
    figures = json.loads((tmp_path / "run.json").read_text())
    assert figures["cause"] == "asked for"
    assert any("the channel has died (exit code -9)" in event for event in figures["events"]) == (mechanism != "hexapod")
    assert replay([tmp_path / "run.mcap"]).same
    assert (read(tmp_path / "run.mcap").records["mode"] == Mode.RUNNING).any()
