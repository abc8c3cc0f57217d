"""The controller's side of the UDP link field by field: what a command says, and what an answer becomes."""

import socket
from contextlib import closing

import numpy as np
import pytest

from hil.rigs import BRAKED, QUICK_STOP, SILENT, Identity, RigError, new_feedback
from hil.rigs.udp.datagrams import COMMAND_DATAGRAM, MEASUREMENT_DATAGRAM, DatagramKind, decode, encode
from hil.rigs.udp.link import bound_socket, decode_answer, new_link, send_command, socket_address
from hil.rigs.udp.rig import UdpRig


def test_an_answer_becomes_the_feedback_field_by_field():
    link, feedback = new_link(), new_feedback()[()]
    link.socket["session"], link.socket["sequence"] = 0x80000007, 0xFFFFFFFE
    values = np.arange(63.0).reshape(3, 7, 3) - 20.5
    speeds = [0.01, -0.02, 0.03, -0.04, 0.05, -0.06]
    content = encode(
        MEASUREMENT_DATAGRAM,
        kind=DatagramKind.MEASUREMENT, session=0x80000007, sequence=0xFFFFFFFE, sample_ns=10**12 + np.arange(7),
        sample_number=4_000_000_000 + np.arange(7), refused=99, drive=[0, 1, 2, 3, 4, 5], code=[0, 1, 2, 0x7500, 0xFFFF, 5],
        velocity=speeds, measurement=values,
    )  # fmt: skip
    link.answer_bytes[: len(content)] = np.frombuffer(content, np.uint8)
    feedback["refused"], feedback["truth"] = 3, 1.0
    assert decode_answer(link, len(content), feedback)
    np.testing.assert_array_equal(feedback["measurement"], values)
    assert feedback["sample_ns"].tolist() == [10**12 + k for k in range(7)]
    assert feedback["sequence"].tolist() == [4_000_000_000 + k for k in range(7)]
    # A state that there is not is not ready.
    assert feedback["drive"].tolist() == [0, 1, 2, 3, 4, 2] and feedback["drive_code"].tolist() == [0, 1, 2, 0x7500, 0xFFFF, 5]
    np.testing.assert_array_equal(feedback["sent"], np.float32(speeds))
    # What this side has refused; and no truth but one that comes with the answer.
    assert feedback["refused"] == 3 and np.isnan(feedback["truth"]).all()
    for other in ("session", "sequence"):
        link.socket[other] += 1
        assert not decode_answer(link, len(content), feedback)
        link.socket[other] -= 1
    assert feedback["refused"] == 5 and decode_answer(link, len(content), feedback)


@pytest.mark.parametrize("reset", [0, 1])
def test_a_command_says_what_it_was_given(reset):
    with closing(bound_socket("127.0.0.1", 0)) as own, closing(bound_socket("127.0.0.1", 0)) as peer:
        peer.settimeout(5.0)
        link = new_link()
        link.socket["descriptor"], link.socket["peer"] = own.fileno(), socket_address(peer.getsockname())
        link.socket["session"], link.socket["sequence"], link.socket["reset"] = 0x80000007, 41, reset
        command = np.array([0.01, -0.02, 0.03, -0.04, 0.05, -0.06])
        for number, request in ((42, QUICK_STOP), (43, BRAKED)):
            send_command(link, command, int(request), 0)
            found = decode(COMMAND_DATAGRAM, peer.recv(2048), kind=DatagramKind.COMMAND)
            assert (found["session"], found["sequence"], found["time_ns"]) == (0x80000007, number, 0)
            assert (found["request"], found["reset"]) == (request, reset)
            np.testing.assert_array_equal(found["velocity"], command.astype(np.float32))


def test_an_address_is_a_sockaddr_in_of_the_network():
    assert socket_address(("192.168.7.2", 0x1234)).tolist() == [socket.AF_INET, 0, 0x12, 0x34, 192, 168, 7, 2, *8 * [0]]


@pytest.mark.parametrize("watchdog, sound", [(0.03, True), (0.0299, False), (0.3, True)])
def test_a_rig_must_wait_for_three_periods_without_a_command(watchdog, sound):
    rig = UdpRig("127.0.0.1:47100", 0.01)
    for call in (rig.identify, rig.arm):
        with pytest.raises(RigError, match="not open"):
            call()
    assert rig.exchange(np.zeros(6), BRAKED, new_feedback()) == SILENT and rig.command_delay == 0.01
    rig._identity, rig.watchdog_s = Identity("a rig"), watchdog
    if sound:
        assert rig.identify().name == "a rig"
    else:
        with pytest.raises(RigError, match=r"after 29\.9 ms without a command; at a period of 10 ms it must be 30 ms"):
            rig.identify()
