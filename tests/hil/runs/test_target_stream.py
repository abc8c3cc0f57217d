"""Streams of targets over real sockets, to a process of its own, followed by a loop on the machine's clock."""

import multiprocessing
import socket
import struct
import time
import zlib
from contextlib import contextmanager

import numpy as np
import pytest

from controller.inverse_kinematics import leg_lengths
from controller.planning.plan_handover import (
    CAUSE,
    CYCLE,
    END_PLANNER,
    SAMPLE_NS,
    SEEN,
    STREAM,
    STREAM_READER,
    TAKEN,
    rest,
    stream_cause,
    take_plan,
)
from controller.planning.segments import evaluate_reference
from controller.planning.stream_planner import Plan, StreamPlanner
from controller.planning.target import load_target
from controller.safety.causes import Cause
from hil.loop.records import shared_array
from hil.runs.target_stream import (
    TARGET_DATAGRAM,
    Faults,
    Reception,
    StreamError,
    decode,
    encode,
    is_last,
    open_socket,
    receive,
    send_target,
)
from plant.errors import InputError
from tests.hil.command_line.test_command_line import gough, refused

FORK = multiprocessing.get_context("fork")
PERIOD = 1e-3
PATIENCE_NS = 100_000_000
LEVEL = (1.0, 0.0, 0.0, 0.0)
HERE = (0.0, 0.0, 0.0)


def home_lengths(mechanism):
    return leg_lengths(mechanism, mechanism.home.position, mechanism.home.rotation)


@pytest.fixture(scope="module", autouse=True)
def _loaded(hexapod):
    """What the loop and a receiver run is loaded before they are on the clock; a receiver's process is forked from this one."""
    follow(np.zeros((), STREAM), np.ones(6), PERIOD)
    stream, planner = np.zeros((), STREAM), StreamPlanner(hexapod, home_lengths(hexapod))
    reception = Reception(stream, planner, PERIOD)
    for number in range(2):
        sent(reception, number, 0.01 * number)
        reception.plan()
    stream["shared"][END_PLANNER] = 1
    with open_socket(port=0) as listener:
        receive(stream, planner, listener, PERIOD)


@contextmanager
def receiving(mechanism, period=PERIOD):
    """A receiver in a process of its own: its stream and its port."""
    stream = shared_array(1, STREAM).reshape(())
    with open_socket(port=0) as listener:
        port = listener.getsockname()[1]
        planner = StreamPlanner(mechanism, home_lengths(mechanism))
        process = FORK.Process(target=receive, args=(stream, planner, listener, period))
        process.start()
        try:
            yield stream, port
        finally:
            stream["shared"][END_PLANNER] = 1
            process.join(5.0)
            ended = process.exitcode
            process.kill()
    assert ended == 0


def follow(stream, lengths, duration):
    """A loop at 1 kHz that follows a stream: times [ns], references (n, 6, 3), and the cause of each cycle."""
    reader, segments, index = np.zeros((), STREAM_READER), rest(lengths), np.zeros(6, np.int64)
    reference = np.zeros((6, 3))
    times, references, causes = [], [], []
    began = time.monotonic_ns()
    for cycle in range(round(duration / PERIOD)):
        due = began + round(1e9 * PERIOD * cycle)
        time.sleep(max(0.0, 1e-9 * (due - time.monotonic_ns())))
        take_plan(stream, reader, cycle, PERIOD, segments, index)
        evaluate_reference(segments, cycle * PERIOD, index, reference)
        times.append(due)
        references.append(reference.copy())
        causes.append(stream_cause(stream, time.monotonic_ns(), PATIENCE_NS))
    return np.array(times), np.array(references), causes


def check(references, limits):
    assert (references[:, :, 0] >= limits.stroke[:, 0] - 1e-9).all()
    assert (references[:, :, 0] <= limits.stroke[:, 1] + 1e-9).all()
    assert np.abs(references[:, :, 1]).max() <= limits.velocity * (1.0 + 1e-9)
    assert np.abs(references[:, :, 2]).max() <= limits.acceleration * (1.0 + 1e-9)
    assert np.abs(np.diff(references[:, :, 2], axis=0)).max() <= limits.jerk * PERIOD * (1.0 + 1e-6)
    assert np.abs(np.diff(references[:, :, 0], axis=0)).max() <= limits.velocity * PERIOD * (1.0 + 1e-6)


def wait_for(condition):
    until = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.002)


def streamed(mechanism, faults=None, duration=1.5, watched=2.5, name="circle"):
    """What a loop makes of a motion that another process sends."""
    target = load_target(name, mechanism, duration)
    with receiving(mechanism) as (stream, port):
        sender = FORK.Process(target=send_target, args=(mechanism, target, 100.0, "127.0.0.1", port, duration, faults))
        sender.start()
        wait_for(lambda: stream["accepted"] > 0)
        times, references, causes = follow(stream, home_lengths(mechanism), watched)
        sender.join()
        assert sender.exitcode == 0
        return target, times, references, causes, stream.copy()


def following_error(mechanism, target, references):
    """The RMS difference [m] between the lengths that a loop followed for 3.5 s and those that were sent.

    Whether the sender or whoever watches began first, and by how much, is not known to a millisecond: the best of all shifts.
    """
    sent = leg_lengths(mechanism, *target.at(np.arange(3500) * PERIOD))
    pairs = [(references[max(s, 0) :, :, 0], sent[max(-s, 0) :]) for s in range(-1100, 1100)]
    return min(np.sqrt(np.mean((ours[:2300] - theirs[:2300]) ** 2)) for ours, theirs in pairs)


@pytest.mark.slow
def test_a_streamed_motion_is_followed_and_ends_at_rest_when_the_stream_does(hexapod):
    # A busy machine may hold up each of the three processes; a lasting fault of the code would show in every try.
    for _ in range(4):
        target, _, references, causes, stream = streamed(hexapod, duration=2.5, watched=3.5)
        check(references, hexapod.limits)
        error = following_error(hexapod, target, references)
        if error < 0.3e-3:
            break
    assert error < 0.3e-3
    assert stream["accepted"] >= 200 and stream["planned"] > 100
    assert stream["late"] < stream["planned"] / 4
    assert (references[-1, :, 1:] == 0.0).all()
    # Its end is no failure: the platform stays at the last pose.
    assert {each[0] for each in causes} == {Cause.NONE}
    np.testing.assert_allclose(references[-1, :, 0], leg_lengths(hexapod, *target.at(np.array([2.5])))[0], atol=1e-7)


@pytest.mark.parametrize(
    ("faults", "cause"),
    [
        (Faults(stop_at=0.7), Cause.TARGET_LOST),
        pytest.param(Faults(jump_at=0.7), Cause.TARGET_JUMPS, marks=pytest.mark.slow),
        pytest.param(Faults(nan_at=0.7), Cause.TARGET_NOT_FINITE, marks=pytest.mark.slow),
    ],
)
def test_a_stream_that_goes_wrong_fails_with_its_cause_and_ends_at_rest(hexapod, faults, cause):
    _, _, references, causes, stream = streamed(hexapod, faults)
    check(references, hexapod.limits)
    assert causes[-1][0] == cause
    if cause == Cause.TARGET_LOST:
        assert causes[-1][2] > causes[-1][3] == pytest.approx(0.1)
    assert Cause.NONE in {each[0] for each in causes}
    assert (references[-1, :, 1:] == 0.0).all()
    assert np.abs(references[:, :, 1]).max() > 1e-3
    assert 20 <= stream["accepted"] <= 71


def test_malformed_stale_repeated_and_strange_datagrams_are_counted_and_refused(hexapod):
    with receiving(hexapod) as (stream, port), socket.socket(type=socket.SOCK_DGRAM) as ours:
        ours.connect(("127.0.0.1", port))
        # The sequence wraps round.
        ours.send(encode(2**32 - 2, 1_000_000_000, HERE, LEVEL))
        ours.send(encode(2**32 - 1, 1_010_000_000, HERE, LEVEL))
        ours.send(encode(2**32, 1_020_000_000, HERE, LEVEL))
        wait_for(lambda: stream["accepted"] == 3)
        for sequence, at in ((0, 1_030_000_000), (2**32 - 1, 1_030_000_000), (1, 1_020_000_000)):
            ours.send(encode(sequence, at, HERE, LEVEL))
        wait_for(lambda: stream["stale"] == 3)
        good = encode(1, 1_030_000_000, HERE, LEVEL)
        for bad in (b"", good[:-1], good + b"\0", bytes(len(good)), good[:20] + b"\x55" + good[21:], 50_000 * b"x"):
            ours.send(bad)
        wait_for(lambda: stream["malformed"] == 6)
        with socket.socket(type=socket.SOCK_DGRAM) as other:
            other.sendto(good, ("127.0.0.1", port))
            wait_for(lambda: stream["strange"] == 1)
        assert stream["accepted"] == 3
        ours.send(good)
        wait_for(lambda: stream["accepted"] == 4)
        assert stream["shared"][CAUSE] == Cause.NONE
        ours.send(encode(2, 1_040_000_000, (0.0, 0.0, 0.4), LEVEL))
        wait_for(lambda: stream["shared"][CAUSE] == Cause.BEYOND_STROKE)
        ours.send(encode(3, 1_050_000_000, HERE, LEVEL))
        time.sleep(0.1)
        assert stream["accepted"] == 4


def test_a_loop_that_does_not_look_gets_no_second_plan(hexapod):
    with receiving(hexapod) as (stream, port), socket.socket(type=socket.SOCK_DGRAM) as ours:
        for k in range(20):
            ours.sendto(encode(k, 10_000_000 * k, (0.0, 0.0, 1e-3 * k), LEVEL), ("127.0.0.1", port))
        wait_for(lambda: stream["accepted"] == 20)
        time.sleep(0.1)
        assert stream["planned"] == 1 and stream["shared"][TAKEN] == 0
        _, references, _ = follow(stream, home_lengths(hexapod), 0.5)
        assert stream["planned"] >= 1 and stream["shared"][TAKEN] >= 1
        assert np.abs(references[-1, :, 0] - references[0, :, 0]).max() > 0.0


def test_a_datagram_is_what_was_packed():
    packed = (7, 123_456_789_012, (0.1, -0.2, 0.3), (0.5, -0.5, 0.5, -0.5))
    datagram = encode(*packed)
    assert len(datagram) == TARGET_DATAGRAM.itemsize == 78
    assert datagram[:6] == b"GGHT\x01\x00"
    found = decode(datagram)
    for name, value in zip(("sequence", "time_ns", "displacement", "quaternion"), packed, strict=True):
        np.testing.assert_array_equal(found[name], value)
    for bit in range(8 * len(datagram)):
        damaged = bytearray(datagram)
        damaged[bit // 8] ^= 1 << bit % 8
        assert decode(bytes(damaged)) is None
    for version in (0, 2):
        body = datagram[:4] + struct.pack("<H", version) + datagram[6:-4]
        assert decode(body + struct.pack("<I", zlib.crc32(body))) is None


# ---------------------------------------------------------------------------------------------------- a receiver, in memory


class Planner:
    """A planner that keeps what it is asked, and whose plans stay where they are."""

    def __init__(self):
        self.samples, self.asked, self.followed, self.ended = [], [], [], []
        self.current = Plan(0.0, np.zeros((6, 24, 5)), None)

    def add(self, at, displacement, quaternion):
        self.samples.append(at)

    def plan(self, begin, at, ended):
        self.asked.append((begin, at))
        self.ended.append(ended)
        return Plan(begin, np.zeros((6, 24, 5)), None)

    def follow(self, plan):
        self.followed.append(plan.begin)
        self.current = plan


def sent(reception, number, time_s):
    reception.take(encode(number, round(1e9 * time_s), HERE, LEVEL), "here")


@pytest.mark.parametrize(("period", "lead"), [(1e-3, 10), (2.5e-4, 40), (3e-3, 4)])
def test_a_plan_begins_ten_milliseconds_ahead_for_the_time_of_the_newest_sample(period, lead):
    stream, planner = np.zeros((), STREAM), Planner()
    reception = Reception(stream, planner, period)
    reception.plan()
    assert planner.asked == []
    sent(reception, 3, 50.0)
    stream["shared"][CYCLE] = 100
    sent(reception, 4, 50.04)
    reception.plan()
    # The sender's clock counts from its first sample. The loop's was at 0, then at 100 cycles, 40 ms after that: on average.
    assert planner.samples == pytest.approx([0.0, 0.04])
    begin = (100 + lead) * period
    assert planner.asked[0] == pytest.approx((begin, begin - (0.04 + (100 * period - 0.04) / 2)))
    assert reception.waits and stream["planned"] == 1 and stream["shared"][SAMPLE_NS] > 0
    np.testing.assert_allclose(stream["begins"].max(), begin)


@pytest.mark.parametrize(("delayed", "off"), [(7, 0.0), (8, 0.04)])
def test_the_clocks_are_compared_by_the_median_of_the_last_fifteen_samples(delayed, off):
    stream, planner = np.zeros((), STREAM), Planner()
    reception = Reception(stream, planner, 1e-3)
    for number in range(25):
        sent(reception, number, 7.0 + 0.01 * number)
        # The next one comes in time, or 40 ms late as so many of the last fifteen do; the first ten were half a second late.
        late = 500 if number < 9 else 40 if number < 9 + delayed else 0
        stream["shared"][CYCLE] = 10 * (number + 1) + late
    reception.plan()
    begin, at = planner.asked[0]
    assert begin == pytest.approx(0.260)
    assert at == pytest.approx(begin - (0.24 + off))


@pytest.mark.parametrize("taken", [True, False])
def test_the_loops_decision_on_a_plan_comes_before_the_next_one(taken):
    stream, planner = np.zeros((), STREAM), Planner()
    reception = Reception(stream, planner, 1e-3)
    sent(reception, 0, 1.0)
    reception.plan()
    sent(reception, 1, 1.01)
    reception.plan()
    assert len(planner.asked) == 1 and planner.followed == []
    stream["shared"][SEEN], stream["shared"][CYCLE] = 1, 5
    stream["shared"][TAKEN] = 1 if taken else 0
    reception.plan()
    assert planner.followed == ([0.01] if taken else []) and stream["late"] == (0 if taken else 1)
    assert len(planner.asked) == 2 and stream["bases"].max() == (1 if taken else 0)
    # No plan begins before the one that is followed.
    assert planner.asked[1][0] == pytest.approx(0.015)
    stream["shared"][[SEEN, TAKEN]] = 2
    planner.current = Plan(0.5, np.zeros((6, 24, 5)), None)
    reception.plan()
    assert len(planner.asked) == 2 and not reception.waits
    planner.current = Plan(0.5, np.zeros((6, 24, 5)), None)
    sent(reception, 2, 1.02)
    reception.plan()
    assert planner.asked[2][0] == 0.5


def test_the_end_of_a_stream_is_planned_until_the_loop_takes_it_and_nothing_comes_after_it():
    stream, planner = np.zeros((), STREAM), Planner()
    reception = Reception(stream, planner, 1e-3)
    sent(reception, 0, 1.0)
    assert stream["shared"][SAMPLE_NS] > 0
    reception.take(encode(1, 1_010_000_000, HERE, LEVEL, last=True), "elsewhere")
    assert stream["strange"] == 1 and stream["shared"][SAMPLE_NS] > 0
    reception.take(encode(1, 1_010_000_000, HERE, LEVEL, last=True), "here")
    assert stream["shared"][SAMPLE_NS] == 0 and planner.samples == pytest.approx([0.0, 0.01])
    assert stream_cause(stream, 10**15, PATIENCE_NS)[0] == Cause.NONE
    # The loop comes too late for the first two plans.
    for number in (1, 2):
        reception.plan()
        stream["shared"][SEEN], stream["shared"][CYCLE] = number, 20 * number
    reception.plan()
    stream["shared"][[SEEN, TAKEN]] = 3
    reception.plan()
    reception.plan()
    assert planner.ended == [True] * 3 and stream["late"] == 2 and len(planner.followed) == 1
    sent(reception, 2, 1.02)
    reception.plan()
    assert len(planner.asked) == 3 and stream["stale"] == 1


def test_a_stream_that_has_failed_takes_and_plans_no_more():
    stream, planner = np.zeros((), STREAM), Planner()
    reception = Reception(stream, planner, 1e-3)
    sent(reception, 0, 1.0)
    stream["shared"][CAUSE] = Cause.TARGET_JUMPS
    reception.plan()
    sent(reception, 1, 1.01)
    assert planner.asked == [] and stream["accepted"] == 1 and len(planner.samples) == 1


def test_an_address_that_is_not_to_be_had_is_refused(hexapod):
    with open_socket(port=0) as taken, pytest.raises(StreamError, match="choose another"):
        open_socket(port=taken.getsockname()[1])
    with pytest.raises(StreamError, match=r"no\.such\.host\.invalid"):
        open_socket("no.such.host.invalid")
    target = load_target("hold", hexapod, 0.1)
    with pytest.raises(StreamError, match="cannot send"):
        send_target(hexapod, target, host="no.such.host.invalid")
    for rate in (0.0, -1.0, np.nan, 1e5):
        with pytest.raises(InputError, match="rate"):
            send_target(hexapod, target, rate)
    with pytest.raises(InputError, match="duration"):
        send_target(hexapod, target, duration=-1.0)


def test_the_command_streams_a_file_in_real_time(tmp_path, hexapod):
    file = tmp_path / "motion.csv"
    rows = [f"{0.1 * k},0,0,{1e-3 * k},1,0,0,0" for k in range(11)]
    file.write_text("\n".join(["time_s,x_m,y_m,z_m,qw,qx,qy,qz", *rows]) + "\n")
    with open_socket(port=0) as listener:
        port = listener.getsockname()[1]
        run = gough("stream-target", "--target", file, "--rate", 50, "--duration", 0.5, "--to", f"127.0.0.1:{port}")
        assert run.returncode == 0, run.stderr
        assert f"26 poses of motion.csv sent to 127.0.0.1:{port}" in run.stdout
        samples, ends = ([decode(listener.recv(100)) for _ in range(count)] for count in (26, 5))
    assert [is_last(each) for each in (*samples, *ends)] == [False] * 26 + [True] * 5
    assert (ends[-1]["displacement"] == samples[-1]["displacement"]).all() and ends[-1]["sequence"] == 30
    assert [sample["sequence"] for sample in samples] == list(range(26))
    assert np.diff([int(sample["time_ns"]) for sample in samples]) == pytest.approx(20_000_000)
    assert samples[-1]["displacement"] == pytest.approx((0.0, 0.0, 5e-3), abs=1e-9)
    assert samples[-1]["quaternion"] == pytest.approx(LEVEL)


def test_the_command_refuses_what_it_cannot_send():
    assert "no address" in refused(gough("stream-target", "--to", "nowhere"))
    assert "no address" in refused(gough("stream-target", "--to", "127.0.0.1:99999"))
    assert "rate" in refused(gough("stream-target", "--rate", 0))
    assert "no target" in refused(gough("stream-target", "--target", "nothing"))
