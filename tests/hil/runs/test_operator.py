"""An operator over real sockets: the channel in a process of its own, and a loop on the clock that follows its plans."""

import asyncio
import json
import multiprocessing
import os
import signal
import socket
import struct
import time
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import pytest
from ruckig import ControlInterface

from controller.frames import ActiveFrames, Frames
from controller.frames.tree import Frame
from controller.inverse_kinematics import leg_lengths
from controller.planning import straight_way
from controller.planning.plan_handover import STREAM, STREAM_READER, rest, stream_cause, take_plan
from controller.planning.points import load_points
from controller.planning.segments import evaluate_reference
from controller.safety.causes import Cause
from controller.workspace import Demands, margins
from hil.loop.records import LINK_SIZE, RECORD, Link, StopRequest, shared_array
from hil.runs.channel_process import MOST_CLIENTS, open_channel
from hil.runs.operated_platform import DEADMAN_S, OperatedPlatform, Workplace
from hil.runs.operator import Operator, RequestRefusedError
from hil.runs.operator_channel import _Channel, serve_channel
from hil.runs.operator_messages import VERSION, ChannelError, channel_address, decode, encode, load_token
from plant.errors import InputError
from plant.mechanism import load_in_space
from plant.pose import rotation_from_vector, vector_from_rotation
from tests.hil.processes import wait_until

FORK = multiprocessing.get_context("fork")
PERIOD = 1e-3
PATIENCE_NS = 10_000_000_000
"""A busy machine is not what is tested here."""
CYCLES = 30_000
TOKEN = "0123456789abcdef0123"
HUGE = 10**400

POINTS = """
[points.left]
position = [-0.01, 0.005, 0.0]
rotation_deg = [0, 0, 2]

[points.corner]
position = [0.02, -0.01, -0.1]
frame = "table"
"""


def looped(stream, lengths, references, shared):
    """A loop at 1 kHz that follows the plans until it is told to end; at a cause it takes no more, and comes to rest."""
    reader, segments, index = np.zeros((), STREAM_READER), rest(lengths), np.zeros(6, np.int64)
    cause = (Cause.NONE, 0, np.nan, np.nan)
    began = time.monotonic_ns()
    for cycle in range(1, CYCLES):
        time.sleep(max(0.0, 1e-9 * (began + round(1e9 * PERIOD * cycle) - time.monotonic_ns())))
        if shared["end"][0]:
            return
        if cause[0] == Cause.NONE:
            take_plan(stream, reader, cycle, PERIOD, segments, index)
            cause = stream_cause(stream, time.monotonic_ns(), PATIENCE_NS)
            shared["cause"][0] = cause
        evaluate_reference(segments, cycle * PERIOD, index, references[cycle])
        shared["cycle"][0] = cycle


class Run:
    """A run that is operated: its processes, and what the loop was told."""

    def __init__(self, mechanism, token=None, points=None, frames=None, processor=None, serve=True):
        self.mechanism, self.token = mechanism, token
        self.stream = shared_array(1, STREAM).reshape(())
        self.link, self.records = shared_array(LINK_SIZE, np.dtype(np.int64)), shared_array(8, RECORD)
        self.kept = shared_array(CYCLES * 18, np.dtype(float)).reshape(CYCLES, 6, 3)
        self.shared = shared_array(
            1, np.dtype([("end", "i8"), ("cycle", "i8"), ("cause", [("c", "i8"), ("i", "i8"), ("v", "f8"), ("l", "f8")])])
        )
        self.workplace = Workplace(mechanism, frames or ActiveFrames(Frames()), Demands(), points or {})
        home = mechanism.home
        self.listener = open_channel("127.0.0.1", 0)
        self.address = f"127.0.0.1:{self.listener.getsockname()[1]}"
        lengths = leg_lengths(mechanism, home.position, home.rotation)
        what = self.listener, token, self.workplace, "operator", PERIOD, self.records, self.link, self.stream, processor
        self.channel = FORK.Process(target=serve_channel, args=what)
        self.loop = FORK.Process(target=looped, args=(self.stream, lengths, self.kept, self.shared))
        self.processes = (self.channel, self.loop) if serve else (self.loop,)
        for process in self.processes:
            process.start()

    def operator(self, **form):
        return Operator(self.address, **{"token": self.token, **form})

    @property
    def cause(self):
        return tuple(self.shared["cause"][0])

    def references(self):
        return self.kept[1 : int(self.shared["cycle"][0]) + 1].copy()

    def check(self):
        """Every cycle within the limits of the legs, and every pose within those of the workspace."""
        from controller.direct_kinematics import poses_from_lengths

        references, limits = self.references(), self.mechanism.limits
        assert np.abs(references[:, :, 1]).max() <= limits.velocity * (1.0 + 1e-9)
        assert np.abs(references[:, :, 2]).max() <= limits.acceleration * (1.0 + 1e-9)
        assert np.abs(np.diff(references[:, :, 2], axis=0)).max() <= limits.jerk * PERIOD * (1.0 + 1e-6)
        assert np.abs(np.diff(references[:, :, 0], axis=0)).max() <= limits.velocity * PERIOD * (1.0 + 1e-6)
        positions, rotations = poses_from_lengths(self.mechanism, references[:, : self.mechanism.legs, 0], self.mechanism.home)
        assert margins(self.mechanism, positions, rotations).values.min() >= -1e-6
        return positions, rotations

    def end(self):
        self.link[Link.DONE] = 1
        self.shared["end"] = 1
        for process in self.processes:
            process.join(5.0)
            process.kill()
        self.listener.close()


@contextmanager
def running(mechanism, **form):
    run = Run(mechanism, **form)
    try:
        yield run
    finally:
        run.end()


@pytest.fixture(scope="module", autouse=True)
def _loaded(hexapod):
    """What both processes run is loaded before they are on the clock; they are forked from this one."""
    OperatedPlatform(np.zeros((), STREAM), Workplace(hexapod, ActiveFrames(Frames())), PERIOD)
    stream, reader, index = np.zeros((), STREAM), np.zeros((), STREAM_READER), np.zeros(6, np.int64)
    segments, reference = rest(np.ones(6)), np.zeros((6, 3))
    take_plan(stream, reader, 0, PERIOD, segments, index)
    stream_cause(stream, 1, PATIENCE_NS)
    evaluate_reference(segments, 0.0, index, reference)
    margins(hexapod, hexapod.home.position[None], hexapod.home.rotation[None])


def begun(operator):
    """Wait until the loop runs."""
    until = time.monotonic() + 20.0
    while operator.ask("state")["telemetry"]["time"] <= 0.0:
        assert time.monotonic() < until
        time.sleep(0.01)


def test_moves_end_where_they_are_told_to_and_stay_within_all_limits_on_a_straight_way(hexapod, tmp_path):
    path = tmp_path / "points.toml"
    path.write_text(POINTS)
    table = Frames({"table": Frame("base", np.array([0.0, 0.0, 0.45]), rotation_from_vector([0.0, 0.0, 0.3]))})
    home = hexapod.home
    with running(hexapod, points=load_points(path), frames=ActiveFrames(table)) as run, run.operator() as operator:
        begun(operator)
        assert operator.run["points"] == ["home", "left", "corner"] and operator.run["mechanism"] == "hexapod"
        assert operator.move("home", wait=False)["duration"] == 0.0
        there = operator.move("left", speed=0.1, turn_speed=1.0)["commanded"]
        np.testing.assert_allclose(there["position"], home.position + [-0.01, 0.005, 0.0], atol=1e-9)
        np.testing.assert_allclose(there["rotation"], [0.0, 0.0, np.radians(2.0)], atol=1e-9)
        # A step is along the axes of the work frame; in a frame it is a pose of the tool there.
        there = operator.step((0.0, 0.0, 0.008), axes="table", speed=0.1)["commanded"]
        np.testing.assert_allclose(there["position"], home.position + [-0.01, 0.005, 0.008], atol=1e-9)
        there = operator.move("corner", speed=0.1, turn_speed=1.0)["commanded"]
        at = np.array([0.0, 0.0, 0.45]) + rotation_from_vector([0.0, 0.0, 0.3]) @ [0.02, -0.01, -0.1]
        np.testing.assert_allclose(there["position"], at, atol=1e-9)
        # A point without a rotation keeps it.
        np.testing.assert_allclose(there["rotation"], [0.0, 0.0, np.radians(2.0)], atol=1e-9)
        positions, _ = run.check()
    np.testing.assert_allclose(positions[-1], at, atol=1e-7)
    # The last way, from where the step ended.
    start = home.position + [-0.01, 0.005, 0.008]
    way = positions[int(np.flatnonzero(np.linalg.norm(positions - start, axis=1) < 1e-7)[-1]) :]
    along = (at - start) / np.linalg.norm(at - start)
    off = (way - start) - ((way - start) @ along)[:, None] * along
    assert np.linalg.norm(off, axis=1).max() < 1.5e-4
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() / PERIOD < 0.1 * 1.03


def test_what_cannot_be_reached_is_refused_with_the_nearest_pose_which_can(hexapod):
    with running(hexapod) as run, run.operator() as operator:
        begun(operator)
        with pytest.raises(
            RequestRefusedError, match=r"stroke of leg \d would be .* mm at .* the nearest pose within"
        ) as refused:
            operator.move({"position": [0.0, 0.0, 0.3]})
        assert not operator.ask("state")["telemetry"]["moving"]
        nearest = refused.value.nearest
        np.testing.assert_allclose(nearest["position"], hexapod.home.position + [0.0, 0.0, 0.0664], atol=1e-4)
        place = {"position": (np.array(nearest["position"]) - hexapod.home.position).tolist(), "rotation": nearest["rotation"]}
        operator.move(place, speed=0.2)
        run.check()
        with pytest.raises(RequestRefusedError, match="at a limit that way: stroke of leg"):
            next(operator.jog((0.0, 0.0, 0.01)))
        for bad, said in (
            ({"to": "nowhere"}, "no point 'nowhere'; there are home"),
            ({"to": {"position": [0, 0]}}, "position must have shape"),
            ({"to": {"positon": [0, 0, 0]}}, "mean 'position'"),
            ({"to": "home", "frame": "table"}, "no frame 'table'"),
            ({"to": "home", "speed": -1}, "speed is -1"),
            ({"to": "home", "speed": "fast"}, "speed is 'fast'; it must be a finite number"),
        ):
            with pytest.raises(RequestRefusedError, match=said) as refused:
                operator.ask("move", **bad)
            assert refused.value.kind == "malformed"
        with pytest.raises(RequestRefusedError, match="there is nothing to move"):
            operator.step()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_number_that_is_not_finite_is_not_sent(hexapod, bad):
    with running(hexapod) as run, run.operator() as operator:
        begun(operator)
        for what in ({"speed": bad}, {"turn_speed": bad}):
            with pytest.raises(InputError, match=f"{next(iter(what))} is {bad}; it must be finite"):
                operator.move("home", **what)
        for where in ({"position": [0.0, bad, 0.0]}, {"rotation": np.array([0.0, bad, 0.0])}):
            with pytest.raises(InputError, match=r"to is .* it must be finite"):
                operator.move(where)
        with pytest.raises(InputError, match=r"translation is .* it must be finite"):
            operator.step((bad, 0.0, 0.0))
        assert operator.ask("state")["telemetry"]["moving"] is False


def test_a_stop_on_the_way_stays_on_it_and_only_one_move_goes_on_at_a_time(hexapod):
    with running(hexapod) as run, run.operator() as operator:
        begun(operator)
        operator.move({"position": [0.03, 0.0, 0.0]}, speed=0.03, wait=False)
        with pytest.raises(RequestRefusedError, match="is moving: stop it first"):
            operator.move("home")
        time.sleep(0.4)
        operator.stop()
        there = operator.wait(0.0)["commanded"]
        x, y, z = np.array(there["position"]) - hexapod.home.position
        assert 0.003 < x < 0.027 and abs(y) < 1e-6 and abs(z) < 1e-6
        positions, _ = run.check()
        np.testing.assert_allclose(positions[-1], there["position"], atol=1e-7)
        assert run.cause[0] == Cause.NONE


def test_a_jog_goes_on_while_it_is_held_and_ends_at_the_first_limit(hexapod):
    with running(hexapod) as run, run.operator() as operator:
        begun(operator)
        operator.watch()
        for _ in operator.jog((0.02, 0.0, 0.0), seconds=0.5):
            pass
        x = operator.wait(0.0)["commanded"]["position"][0]
        assert 0.006 < x < 0.014
        for _ in operator.jog((0.0, 0.0, 0.2)):
            pass
        operator.wait(0.0)
        operator.listen(0.2)
        assert any(each["event"].startswith("stopped at a limit: stroke of leg") for each in operator.events)
        assert operator.telemetry["jogging"] is False
        positions, rotations = run.check()
        assert margins(hexapod, positions[-1:], rotations[-1:]).of("stroke").min() < 2e-4
        assert run.cause[0] == Cause.NONE


def jog_until_killed(address):
    with Operator(address) as operator:
        for _ in operator.jog((0.03, 0.0, 0.0)):
            pass


@pytest.mark.parametrize("how", ["killed", "silent"])
def test_an_operator_who_goes_away_while_jogging_is_a_controlled_stop(hexapod, how):
    """Killed, or alive but without a sign, as when its network is cut."""
    with running(hexapod) as run:
        with run.operator() as operator:
            begun(operator)
        client = FORK.Process(target=jog_until_killed, args=(run.address,))
        client.start()
        until = time.monotonic() + 20.0
        while not np.abs(run.references()[-1:, :, 1]).max(initial=0.0) > 0.005:
            assert time.monotonic() < until
            time.sleep(0.01)
        os.kill(client.pid, signal.SIGKILL if how == "killed" else signal.SIGSTOP)
        began = time.monotonic()
        while run.cause[0] == Cause.NONE:
            assert time.monotonic() - began < 5.0
            time.sleep(0.005)
        cause, index, waited, limit = run.cause
        assert cause == Cause.OPERATOR_LOST
        said = Cause(cause).describe(index, waited, limit)
        if how == "killed":
            assert said == "the operator has gone while the platform was jogged"
        else:
            assert waited > limit == DEADMAN_S and said.startswith("the operator has gone while the platform was jogged (0.")
        os.kill(client.pid, signal.SIGKILL)
        client.join()
        time.sleep(0.5)
        run.check()
        assert np.abs(run.references()[-1, :, 1:]).max() < 1e-9
        # The run is over for the next one, too.
        with run.operator() as operator, pytest.raises(RequestRefusedError, match="the run stops: the operator has gone"):
            operator.move("home")


def test_a_planar_mechanism_moves_in_its_plane_alone():
    planar = load_in_space("planar-3rpr")
    home, home_turn = planar.home.position, vector_from_rotation(planar.home.rotation)
    with running(planar) as run, run.operator() as operator:
        begun(operator)
        assert operator.run["machine"]["planar"]
        there = operator.step((0.01, -0.005, 0.0), (0.0, 0.0, 0.05), speed=0.1, turn_speed=1.0)["commanded"]
        np.testing.assert_allclose(there["position"], home + [0.01, -0.005, 0.0], atol=1e-9)
        np.testing.assert_allclose(there["rotation"], home_turn + [0.0, 0.0, 0.05], atol=1e-9)
        for _ in operator.jog((0.0, 0.02, 0.0), seconds=0.3):
            pass
        y = operator.wait(0.0)["commanded"]["position"][1]
        assert 0.001 < y - home[1] + 0.005 < 0.012
        in_plane = "planar-3rpr moves in its plane alone, along x and y and about z"
        for bad in (
            lambda: operator.step((0.0, 0.0, 0.005)),
            lambda: operator.step(rotation=(0.1, 0.0, 0.0)),
            lambda: operator.move({"position": [0.0, 0.0, 0.01]}),
            lambda: operator.follow({"position": [0.0, 0.0, 0.01]}),
            lambda: next(operator.jog(turn_velocity=(0.0, 0.1, 0.0))),
        ):
            with pytest.raises(RequestRefusedError, match=in_plane):
                bad()
        with pytest.raises(RequestRefusedError, match=r"stroke of leg \d would be .* the nearest pose within") as refused:
            operator.move({"position": [0.0, 1.0, 0.0]})
        assert refused.value.nearest["position"][2] == 0.0
        operator.move("home", speed=0.1, turn_speed=1.0)
        positions, _ = run.check()
        np.testing.assert_allclose(positions[-1], home, atol=1e-7)
        assert not run.references()[:, 3:].any() and run.cause[0] == Cause.NONE


@pytest.mark.slow
def test_a_goal_that_changes_is_followed_without_a_rest_and_within_all_limits(hexapod):
    home = hexapod.home.position
    with running(hexapod) as run, run.operator() as operator:
        begun(operator)
        begin = int(run.shared["cycle"][0])
        for number in range(1, 21):
            operator.follow({"position": [0.003 * number, -0.0015 * number, 0.0], "rotation": [0.0, 0.0, 0.004 * number]})
            time.sleep(0.05)
        under_way = int(run.shared["cycle"][0])
        with pytest.raises(RequestRefusedError, match="the platform is moving: stop it first"):
            operator.move("home")
        with pytest.raises(RequestRefusedError, match=r"stroke of leg \d would be .* mm, with a limit of"):
            operator.follow({"position": [0.0, 0.0, 0.3]})
        there = operator.wait(3.0)["commanded"]
        np.testing.assert_allclose(there["position"], home + [0.06, -0.03, 0.0], atol=1e-9)
        np.testing.assert_allclose(there["rotation"], [0.0, 0.0, 0.08], atol=1e-9)
        # It never rests between goals.
        speeds = np.abs(run.kept[begin + 300 : under_way, :, 1]).max(axis=1)
        assert speeds.min() > 1e-3
        # Back and forth, with a stop on the way.
        operator.follow("home")
        time.sleep(0.1)
        operator.follow({"position": [0.02, 0.0, 0.0], "rotation": [0.1, 0.0, 0.0]})
        time.sleep(0.2)
        operator.stop()
        operator.wait(0.0)
        operator.follow({"position": [0.0, 0.01, 0.0], "rotation": [0.0, 0.0, 0.0]})
        time.sleep(0.1)
        operator.pause()
        assert operator.wait(0.0)["paused"]
        there = operator.resume()["commanded"]
        np.testing.assert_allclose(there["position"], home + [0.0, 0.01, 0.0], atol=1e-9)
        positions, _ = run.check()
        np.testing.assert_allclose(positions[-1], there["position"], atol=1e-7)
        assert run.cause[0] == Cause.NONE


@pytest.mark.slow
def test_a_flood_of_requests_holds_up_neither_the_platform_nor_an_observer(hexapod):
    """A thousand orders at once, of which each takes a while; channel and clients take turns in one process."""
    with running(hexapod, serve=False) as run:
        platform = OperatedPlatform(run.stream, run.workplace, PERIOD)
        channel = _Channel(platform, run.workplace, "operator", None, PERIOD, run.records, run.link)
        answers = {"operator": 0, "observer": 0}

        async def ask(role, requests):
            reader, writer = await asyncio.open_connection(*run.listener.getsockname())
            writer.write(encode({"gough": VERSION, "role": role}))
            assert decode(await reader.readline())["ok"]
            writer.write(b"".join(encode({"id": 1, **request}) for request in requests))
            for _ in requests:
                assert decode(await reader.readline())["ok"]
                answers[role] += 1
            writer.close()
            return dict(answers)

        async def flood():
            serving = asyncio.create_task(channel.run(run.listener))
            orders = [{"do": "follow", "to": {"position": [0.02 + 1e-6 * number, 0.0, 0.0]}} for number in range(1000)]
            _, seen = await asyncio.gather(ask("operator", orders), ask("observer", [{"do": "state"}] * 20))
            run.link[Link.DONE] = 1
            await serving
            return seen["operator"]

        wait_until(lambda: run.shared["cycle"][0] > 0, "the loop runs")
        assert asyncio.run(asyncio.wait_for(flood(), 120.0)) < 100
        assert run.cause[0] == Cause.NONE
        run.check()


@pytest.mark.slow
def test_a_way_that_is_followed_keeps_to_the_limits_between_two_poses_that_can_be_reached(hexapod):
    first, last = (0.109, -0.028, -0.01, 0.027, 0.122, 0.036), (-0.01, 0.118, -0.018, 0.283, 0.015, -0.01)
    middle = 0.5 * np.add(first, last)
    position, rotation = hexapod.home.position + middle[:3], rotation_from_vector(middle[3:])
    assert margins(hexapod, position[None], rotation[None]).of("stroke").min() < -5e-3
    with running(hexapod) as run, run.operator() as operator:
        begun(operator)
        operator.move({"position": first[:3], "rotation": first[3:]}, speed=0.3, turn_speed=2.0)
        with pytest.raises(RequestRefusedError, match="on the straight way there, stroke of leg"):
            operator.move({"position": last[:3], "rotation": last[3:]})
        operator.follow({"position": last[:3], "rotation": last[3:]})
        there = operator.wait(10.0)["commanded"]
        positions, _ = run.check()
        np.testing.assert_allclose(positions[-1], there["position"], atol=1e-6)
        assert run.cause[0] == Cause.NONE


def test_a_move_that_is_paused_goes_on_to_its_end_and_a_jog_stops(hexapod):
    with running(hexapod) as run, run.operator() as operator:
        begun(operator)
        with pytest.raises(RequestRefusedError, match="no move has been paused"):
            operator.resume()
        goal = {"position": [0.02, 0.0, 0.005], "rotation": [0.0, 0.0, 0.03]}
        operator.move(goal, speed=0.03, wait=False)
        time.sleep(0.3)
        operator.pause()
        there = operator.wait(0.0)
        assert there["paused"] and 0.001 < there["commanded"]["position"][0] < 0.019
        operator.move({"position": [0.0, 0.0, 0.0], "relative": True})
        assert operator.ask("state")["telemetry"]["paused"]
        there = operator.resume()
        np.testing.assert_allclose(there["commanded"]["position"], hexapod.home.position + goal["position"], atol=1e-9)
        np.testing.assert_allclose(there["commanded"]["rotation"], goal["rotation"], atol=1e-9)
        assert not there["paused"]
        # The whole way is that of one move.
        positions, _ = run.check()
        along = np.array(goal["position"]) / np.linalg.norm(goal["position"])
        off = (positions - hexapod.home.position) - ((positions - hexapod.home.position) @ along)[:, None] * along
        assert np.linalg.norm(off, axis=1).max() < 1.5e-4
        # Another move takes the place of what was paused, and so does who comes next.
        operator.move("home", speed=0.03, wait=False)
        operator.pause()
        operator.wait(0.0)
        operator.step((0.001, 0.0, 0.0))
        with pytest.raises(RequestRefusedError, match="no move has been paused"):
            operator.resume()
        operator.ask("jog", velocity=[-0.01, 0.0, 0.0])
        operator.pause()
        assert not operator.wait(0.0)["paused"]
        operator.move("home", speed=0.03, wait=False)
        operator.pause()
        operator.close()
        time.sleep(0.2)
        with run.operator() as another:
            another.wait(0.0)
            with pytest.raises(RequestRefusedError, match="no move has been paused"):
                another.resume()
        assert run.cause[0] == Cause.NONE


def test_a_client_that_leaves_a_move_does_not_stop_it(hexapod):
    with running(hexapod) as run:
        with run.operator() as operator:
            begun(operator)
            operator.move({"position": [0.01, 0.0, 0.0]}, wait=False)
        with run.operator() as operator:
            there = operator.wait(2.0)["commanded"]
        assert there["position"][0] == pytest.approx(0.01) and run.cause[0] == Cause.NONE


def listen_to_the_newest(observer):
    """What has come meanwhile is taken in at once; then the next one is waited for."""
    observer.watch(2.0)
    time.sleep(1.6)
    began = time.monotonic()
    observer.listen(60.0, newest=True)
    observer.listen(60.0, newest=True)
    assert 0.1 < time.monotonic() - began < 30.0


@pytest.mark.slow
def test_one_operator_at_a_time_and_observers_who_give_no_orders(hexapod):
    with running(hexapod) as run, run.operator(name="panel") as operator:
        with pytest.raises(ChannelError, match="panel operates this run, and only one may") as refused:
            run.operator()
        assert refused.value.kind == "busy"
        with run.operator(role="observer") as observer:
            observer.watch(20.0)
            observer.listen(0.5)
            assert observer.telemetry["mode"] == "preparing" and observer.telemetry["commanded"]["position"][2] == 0.35
            listen_to_the_newest(observer)
            for order in ("move", "follow", "step", "jog", "stop", "pause", "resume", "beat"):
                with pytest.raises(RequestRefusedError, match="an observer gives no orders but to end the run"):
                    observer.ask(order)
            assert run.link[Link.STOP] == 0
            # Whoever else operates.
            observer.end()
            assert run.link[Link.STOP] == StopRequest.CONTROLLED
            observer.emergency()
            assert run.link[Link.STOP] == StopRequest.QUICK
        run.link[Link.STOP] = 0
        operator.end()
        assert run.link[Link.STOP] == StopRequest.CONTROLLED
        operator.emergency()
        assert run.link[Link.STOP] == StopRequest.QUICK
        operator.end()
        assert run.link[Link.STOP] == StopRequest.QUICK
        operator.close()
        time.sleep(0.2)
        run.operator().close()


def test_a_run_ends_when_it_is_told_to_though_its_move_cannot_be_stopped(hexapod, monkeypatch):
    """The channel's process plans with a ruckig that refuses all stops."""
    planned, refuses = straight_way.calculate, shared_array(1, np.dtype(np.int64))

    def without_stops(otg, parameters, state, trajectory):
        if refuses[0] and parameters.control_interface == ControlInterface.Velocity:
            parameters.max_jerk = [-1.0]
        return planned(otg, parameters, state, trajectory)

    monkeypatch.setattr(straight_way, "calculate", without_stops)
    with running(hexapod) as run, run.operator() as operator:
        begun(operator)
        operator.move({"position": [0.03, 0.0, 0.0]}, speed=0.03, wait=False)
        refuses[0] = 1
        operator.end()
        assert run.link[Link.STOP] == StopRequest.CONTROLLED
        with pytest.raises(RequestRefusedError, match="ruckig finds no way"):
            operator.stop()


def test_a_client_that_resets_the_connection_while_it_is_greeted_keeps_no_place(hexapod):
    """At each turn of the event loop, from the one in which its greeting is sent."""
    link, records = np.zeros(LINK_SIZE, np.int64), np.zeros(8, RECORD)
    workplace = Workplace(hexapod, ActiveFrames(Frames()), Demands(), {})
    channel = _Channel(None, workplace, "circle", None, PERIOD, records, link)
    hello = encode({"gough": VERSION, "role": "operator"})

    async def greeted(address):
        """Whether the operator's place is free soon."""
        for _ in range(100):
            reader, writer = await asyncio.open_connection(*address)
            writer.write(hello)
            ok = decode(await reader.readline())["ok"]
            writer.close()
            if ok:
                return True
            await asyncio.sleep(0.01)
        return False

    async def greet_and_reset(listener):
        serving, address = asyncio.create_task(channel.run(listener)), listener.getsockname()
        for turns in range(12):
            with socket.create_connection(address) as raw:
                # It is accepted meanwhile.
                await asyncio.sleep(0.01)
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                raw.sendall(hello)
                for _ in range(turns):
                    await asyncio.sleep(0)
            assert await greeted(address), f"reset after {turns} turns"
        link[Link.DONE] = 1
        await serving

    with open_channel("127.0.0.1", 0) as listener:
        asyncio.run(greet_and_reset(listener))


def said(address, *lines):
    """What the server answers to raw lines, until it closes or is silent."""
    host, port = channel_address(address, None)
    with socket.create_connection((host, port), timeout=1.0) as raw:
        answer = b""
        try:
            for line in lines:
                raw.sendall(line)
            while part := raw.recv(65536):
                answer += part
        except (TimeoutError, ConnectionResetError, BrokenPipeError):
            pass
    return [json.loads(line) for line in answer.splitlines()]


def test_neither_who_says_nothing_nor_all_the_observers_keep_the_operator_out(hexapod):
    with running(hexapod, token=TOKEN) as run, ExitStack() as others:
        address = channel_address(run.address, None)
        silent = [others.enter_context(socket.create_connection(address)) for _ in range(3 * MOST_CLIENTS)]
        watching = [others.enter_context(run.operator(role="observer")) for _ in range(MOST_CLIENTS)]
        with pytest.raises(ChannelError, match=f"{MOST_CLIENTS} observers watch this run, and no more may") as refused:
            run.operator(role="observer")
        assert refused.value.kind == "busy"
        silent += [others.enter_context(socket.create_connection(address)) for _ in range(MOST_CLIENTS)]
        with run.operator() as operator:
            begun(operator)
        # The first ones have made room.
        silent[0].settimeout(5.0)
        with suppress(ConnectionResetError):
            assert silent[0].recv(1) == b""
        watching[0].close()
        until = time.monotonic() + 5.0
        while True:
            with suppress(ChannelError):
                run.operator(role="observer").close()
                break
            assert time.monotonic() < until
            time.sleep(0.02)


MALFORMED = [
    {"do": []}, {"do": {}}, {"do": None}, {"do": "state", "id": 1.5}, {"do": "watch", "rate": HUGE}, {"do": "jog"},
    {"do": "jog", "velocity": [0.01, 0.0, 0.0], "deadman": HUGE}, {"do": "jog", "velocity": [0.01, 0.0, 0.0], "deadman": True},
    {"do": "jog", "velocity": [0.01, 0.0]}, {"do": "jog", "turn_velocity": "fast"}, {"do": "jog", "velocity": [HUGE, 0, 0]},
    {"do": "step", "translation": [0.001, 0.002]}, {"do": "step", "rotation": None}, {"do": "step", "translation": {"x": 1}},
    {"do": "step", "translation": [[0.001], [0.0, 1.0], 0.0]}, {"do": "step", "translation": [1e200, 0.0, 0.0]},
    {"do": "step", "translation": [0.0] * 10_000}, {"do": "move", "to": "home", "speed": HUGE}, {"do": "move", "to": [0, 0, 0]},
    {"do": "move", "to": {"position": [HUGE, 0, 0]}}, {"do": "move", "to": {"position": [0, 0, 0], "relative": []}},
    {"do": "move", "to": 3, "frame": []}, {"do": "follow"}, {"do": "follow", "to": {"rotation": [1e308, 1e308, 1e308]}},
]  # fmt: skip
"""What no client should send, and one of another maker might."""


@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_whatever_is_asked_for_is_answered_and_the_client_keeps_its_connection(name):
    with running(load_in_space(name)) as run, run.operator() as operator:
        begun(operator)
        for request in MALFORMED:
            operator._send({"id": 7, **request} if isinstance(request["do"], str) else request)
            answer = operator._line(time.monotonic() + 5.0)
            assert answer["ok"] is False and answer["kind"] in ("malformed", "refused"), (request, answer)
            assert len(answer["error"]) <= 1000
        # Much too far, which costs no more than any other way that is refused.
        with pytest.raises(RequestRefusedError, match=r"of leg \d would be"):
            operator.step((1e6 if name == "hexapod" else 0.0, 1e6, 0.0))
        assert operator.ask("state")["telemetry"]["moving"] is False and run.cause[0] == Cause.NONE


def test_a_token_is_asked_for_and_nobody_else_gets_in(hexapod):
    hello = {"gough": VERSION, "role": "operator"}
    with running(hexapod, token=TOKEN) as run:
        for token in (None, "", TOKEN[:-1], TOKEN + "0", "\u00e9" * 20):
            with pytest.raises(ChannelError, match="the token is wrong") as refused:
                Operator(run.address, token)
            assert refused.value.kind == "token"
        for wrong in (12, ["a"], {"a": 1}):
            assert said(run.address, encode({**hello, "token": wrong}))[0]["kind"] == "token"
        assert said(run.address, encode({"gough": 2, "token": TOKEN}))[0]["kind"] == "version"
        # As a browser's page might send it.
        for garbage in (b"POST / HTTP/1.1\r\n", b"[1]\n", b"\xff\xfe\n", b"x" * 200_000 + b"\n", b"[" * 60_000 + b"\n"):
            answers = said(run.address, garbage, encode({**hello, "token": TOKEN}))
            assert all(not each["ok"] for each in answers) and len(answers) <= 1
        assert said(run.address, encode({**hello, "token": TOKEN, "role": "king"}))[0]["kind"] == "malformed"
        answers = said(
            run.address, encode({**hello, "token": TOKEN}), b"nonsense\n", b'{"id": [1], "do": "state"}\n', b'{"do": 3}\n'
        )
        assert [each["ok"] for each in answers] == [True, False, False, False]
        with run.operator() as operator:
            assert operator.ask("state")["telemetry"]["moving"] is False
        assert run.channel.is_alive()


def test_beyond_this_machine_a_channel_needs_a_token(tmp_path, monkeypatch):
    assert channel_address("127.0.0.1:47300", None) == ("127.0.0.1", 47300)
    with pytest.raises(InputError, match="would take orders from other machines: give a token"):
        channel_address("192.168.1.5:47300", None)
    assert channel_address("192.168.1.5:47300", TOKEN) == ("192.168.1.5", 47300)
    path = tmp_path / "token"
    monkeypatch.delenv("GOUGH_TOKEN", raising=False)
    assert load_token(None) is None
    path.write_text(f"{TOKEN}\n")
    assert load_token(str(path)) == TOKEN
    monkeypatch.setenv("GOUGH_TOKEN", TOKEN + "1")
    assert load_token(None) == TOKEN + "1" and load_token(str(path)) == TOKEN
    path.write_text("short\n")
    with pytest.raises(InputError, match="has 5 characters; it needs 16"):
        load_token(str(path))
    with pytest.raises(InputError, match="cannot be read"):
        load_token(str(tmp_path / "none"))


def test_messages_are_lines_of_json_in_which_what_is_not_finite_is_null():
    line = encode({"a": np.array([1.0, np.nan]), "b": (np.float64(np.inf), np.int64(3)), "c": {"d": None}})
    assert line.endswith(b"\n") and decode(line) == {"a": [1.0, None], "b": [None, 3], "c": {"d": None}}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no points"),
        ("points = 3", "has no points"),
        ("[points.home]\nposition = [0, 0, 0]", "'home' is the mechanism's own"),
        ("[points.a]\npositon = [0, 0, 0]", r"\[points.a\].*mean 'position'"),
        ("[points.a]\nframe = 3", "frame is 3; it must be a text"),
        ("[points]\na = 3", r"\[points.a\] is 3; it must be a table"),
    ],
)
def test_a_bad_file_of_points_is_refused(tmp_path, text, said):
    path = tmp_path / "points.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        load_points(path)
