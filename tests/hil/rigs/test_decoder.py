"""The frames of a CANopen rig byte by byte, and what the decoder makes of them, with nodes and signs unlike the defaults."""

import struct

import can
import numpy as np
import pytest

from hil.rigs.canopen.decoder import Decoder
from hil.rigs.canopen.frames import NO_VALUE, NodeState, new_message, pack_imu, raw_readings, truth_message
from hil.rigs.canopen.settings import canopen_settings

DRIVES, IMUS = [41, 7, 23, 3, 55, 12], [70, 64, 99, 61, 88, 93, 62]
SIGNS = [[1, -1, 1], [-1, -1, 1], [1, 1, -1], [-1, 1, 1], [1, -1, -1], [-1, -1, -1], [-1, 1, -1]]
SCALES = 2e-4, 3e-3, 0.07
MS = 1_000_000


def settings(fd):
    scales = dict(zip(("gyroscope_scale", "accelerometer_scale", "magnetometer_scale"), SCALES, strict=True))
    return canopen_settings(
        bus={"interface": "virtual", "fd": fd},
        controller={"node": 100},
        drives={"nodes": DRIVES},
        imus={"nodes": IMUS, "signs": SIGNS, **scales},
    )


def readings():
    """In LSB, all different."""
    return 100 * np.arange(1, 64, dtype=np.int16).reshape(3, 7, 3) - 3000


def physical(raw):
    return raw * np.array(SCALES)[:, None, None] * np.array(SIGNS)


def measurement_of(decoder):
    found = np.zeros((3, 7, 3))
    decoder.write_measurement(found)
    return found


def send(decoder, imu, fd, raw=None, number=1, sample_ns=0, sync=1, magnetometer=False):
    """All frames of a sample; returns which were taken."""
    raw = readings()[:, imu] if raw is None else raw
    return [
        decoder.take(new_message(cob_id + IMUS[imu], data))
        for cob_id, data in pack_imu(raw, number, sample_ns, sync, fd, magnetometer)
    ]


# --------------------------------------------------------------------------------------------------------------- frames


def test_a_sample_on_can_fd_byte_by_byte():
    ((cob_id, data),) = pack_imu(readings()[:, 3], 2**32 + 5, 7_654_321_987, 239, True, False)
    assert cob_id == 0x180 and len(data) == 32 and data[27:] == bytes(5)
    assert struct.unpack("<9hIIB", data[:27]) == (*readings()[:, 3].ravel(), 5, 7_654_321, 239)


@pytest.mark.parametrize("magnetometer", [False, True])
def test_a_sample_on_classic_can_byte_by_byte(magnetometer):
    frames = dict(pack_imu(readings()[:, 3], 256 + 5, 7_654_321_987, 239, False, magnetometer))
    assert list(frames) == [0x180, 0x280, 0x380][: 3 if magnetometer else 2]
    gyroscope, accelerometer, field = readings()[:, 3].tolist()
    assert struct.unpack("<3hBB", frames[0x180]) == (*gyroscope, 5, 239)
    # In units of 10 us, which wrap at 16 bits.
    assert struct.unpack("<3hH", frames[0x280]) == (*accelerometer, 765_432 % 65_536)
    if magnetometer:
        assert struct.unpack("<3hBB", frames[0x380]) == (*field, 239, 0)


def test_readings_are_rounded_limited_and_signed():
    scales = settings(True).imus.scales
    np.testing.assert_allclose(scales, physical(np.ones((3, 7, 3))), rtol=1e-15)
    measurement = 0.4 * scales
    measurement[0, 0] = [0.6 * SCALES[0], 0.6 * SCALES[0], -1.4 * SCALES[0]]
    measurement[1, 1] = [1e6, -1e6, np.nan]
    measurement[2, 6] = [np.inf, -40_000 * SCALES[2], 32_767 * SCALES[2]]
    raw = raw_readings(measurement, scales)
    assert raw[0, 0].tolist() == [1, -1, -1]
    assert raw[1, 1].tolist() == [-32767, 32767, NO_VALUE]
    assert raw[2, 6].tolist() == [-32767, -32767, -32767]
    assert (np.delete(raw[0], 0, axis=0) == 0).all()


# -------------------------------------------------------------------------------------------------------------- decoder


@pytest.mark.parametrize("fd", [True, False])
def test_each_imus_readings_arrive_in_their_place_with_scale_and_sign(fd):
    decoder = Decoder(settings(fd))
    decoder.begin(17)
    for imu in np.random.default_rng(1).permutation(7).tolist():
        taken = send(decoder, imu, fd, number=10 + imu, sample_ns=(100 + imu) * MS, sync=17, magnetometer=True)
        assert all(taken) and len(taken) == (1 if fd else 3)
    np.testing.assert_allclose(measurement_of(decoder), physical(readings()), rtol=1e-15)
    assert decoder.sequence == [10, 11, 12, 13, 14, 15, 16]
    assert decoder.sample_ns == [(100 + imu) * MS for imu in range(7)]
    assert decoder.answered and decoder.refused == 0


@pytest.mark.parametrize("fd", [True, False])
def test_without_a_sample_a_reading_is_nan(fd):
    decoder = Decoder(settings(fd))
    assert np.isnan(measurement_of(decoder)).all() and decoder.sequence == 7 * [-1]
    decoder.begin(1)
    raw = readings()[:, 2].copy()
    raw[0, 1] = raw[1, 2] = NO_VALUE
    send(decoder, 2, fd, raw, magnetometer=True)
    found = measurement_of(decoder)
    assert np.argwhere(np.isnan(found[:, 2])).tolist() == [[0, 1], [1, 2]]
    assert np.isnan(np.delete(found, 2, axis=1)).all()


@pytest.mark.parametrize("fd", [True, False])
def test_numbers_and_times_go_on_when_their_counters_wrap(fd):
    """Over some of the 8 bits and 655.36 ms of classic CAN, and from just before the ends of the 32 bits of CAN FD."""
    decoder = Decoder(settings(fd))
    number, sample_ns = (2**32 - 3, (2**32 - 5000) * 1000) if fd else (250, 640 * MS)
    begin = number, sample_ns
    for cycle in range(600):
        decoder.now_ns += 4 * MS
        decoder.begin(cycle % 240 + 1)
        if cycle % 3 != 2:
            assert all(send(decoder, 5, fd, number=number, sample_ns=sample_ns, sync=cycle % 240 + 1))
            assert (decoder.sequence[5], decoder.sample_ns[5]) == (number, sample_ns)
        number, sample_ns = number + 1, sample_ns + 4 * MS
        decoder.end()
    assert number - begin[0] == 600 and sample_ns - begin[1] == 2400 * MS


@pytest.mark.parametrize("fd", [True, False])
def test_a_repeated_sample_leaves_number_and_time_and_is_an_answer(fd):
    decoder = Decoder(settings(fd))
    for sync in (1, 2):
        decoder.begin(sync)
        decoder.answered = False
        send(decoder, 4, fd, number=9, sample_ns=(50 + sync) * MS, sync=sync)
        assert decoder.answered and (decoder.sequence[4], decoder.sample_ns[4]) == (9, 51 * MS)


@pytest.mark.parametrize("fd", [True, False])
def test_an_imu_that_restarts_goes_on_from_its_last_number(fd):
    decoder = Decoder(settings(fd))
    for sync, (number, sample_ns) in enumerate([(200, 600 * MS), (100, 300 * MS), (101, 304 * MS)], 1):
        decoder.now_ns += 4 * MS
        decoder.begin(sync)
        send(decoder, 0, fd, number=number, sample_ns=sample_ns, sync=sync)
    assert (decoder.sequence[0], decoder.sample_ns[0]) == (202, 608 * MS)


def test_on_classic_can_a_sample_needs_its_first_half_of_this_sync():
    decoder = Decoder(settings(False))
    (_, first), (_, second), (_, _) = pack_imu(readings()[:, 6], 5, 8 * MS, 30, False, True)
    decoder.begin(30)
    assert not decoder.take(new_message(0x280 + IMUS[6], second))
    assert decoder.take(new_message(0x180 + IMUS[6], first)) and not decoder.answered
    assert np.isnan(measurement_of(decoder)).all()
    assert decoder.take(new_message(0x280 + IMUS[6], second)) and decoder.answered
    np.testing.assert_allclose(measurement_of(decoder)[:2, 6], physical(readings())[:2, 6])
    decoder.begin(31)
    assert not decoder.take(new_message(0x180 + IMUS[6], first))
    assert not decoder.take(new_message(0x280 + IMUS[6], second))
    assert decoder.refused == 3 and decoder.sequence[6] == 5


@pytest.mark.parametrize(
    "sync, of, taken", [(30, 30, True), (30, 29, True), (30, 28, False), (30, 31, False), (1, 240, True), (1, 239, False)]
)
def test_a_magnetometer_may_be_one_sync_late(sync, of, taken):
    decoder = Decoder(settings(False))
    decoder.begin(sync)
    message = new_message(0x380 + IMUS[1], readings()[2, 1].tobytes() + bytes((of, 0)))
    assert decoder.take(message) is taken
    assert np.isfinite(measurement_of(decoder)[2, 1]).all() == taken
    # And comes once.
    assert not decoder.take(message)
    assert decoder.refused == 2 - taken


@pytest.mark.parametrize("fd, count", [(True, 13), (False, 20)])
def test_each_frame_that_is_missing_has_a_bit_of_its_own(fd, count):
    decoder = Decoder(settings(fd))
    every = (1 << count) - 1
    assert decoder.end() == 0
    decoder.begin(1)
    assert decoder.awaited == every and decoder.end() == every
    decoder.begin(2)
    assert decoder.take(new_message(0x180 + DRIVES[2], struct.pack("<HiH", 0x1237, -70_000, 0x2310)))
    assert decoder.end() == every & ~(1 << 2)
    decoder.begin(3)
    send(decoder, 4, fd, sync=3, magnetometer=True)
    of_imu = 1 << 10 if fd else 1 << 10 | 1 << 17
    assert decoder.end() == every & ~of_imu
    # What comes after the end is late, and what was given up is awaited again.
    decoder.awaited &= ~(1 << 2)
    refused = decoder.refused
    assert not decoder.take(new_message(0x180 + DRIVES[2], struct.pack("<HiH", 0, 0, 0)))
    assert decoder.refused == refused + 1 and decoder.awaited == every and decoder.statuswords[2] == 0x1237
    decoder.awaited &= ~(1 << 2)
    decoder.begin(4)
    assert decoder.take(new_message(0x180 + DRIVES[2], struct.pack("<HiH", 1, 2, 3))) and decoder.awaited == every


def test_drives_answers_heartbeats_and_emergencies_are_noted_by_drive():
    decoder = Decoder(settings(True))
    decoder.begin(1)
    for drive, node in enumerate(DRIVES):
        decoder.now_ns = 1000 + drive
        assert decoder.take(new_message(0x180 + node, struct.pack("<HiH", 0x1230 + drive, -70_000 * drive, 0x2310 + drive)))
    assert decoder.statuswords == [0x1230 + drive for drive in range(6)]
    assert decoder.velocities == [-70_000 * drive for drive in range(6)]
    assert decoder.error_codes == [0x2310 + drive for drive in range(6)]
    assert decoder.heard_ns == [1000, 1001, 1002, 1003, 1004, 1005, 0, 0, 0, 0, 0, 0, 0]
    decoder.now_ns = 5000
    assert decoder.take(new_message(0x700 + DRIVES[3], b"\x7f")) and decoder.take(new_message(0x700 + IMUS[2], b"\x05"))
    assert decoder.nmt == [-1, -1, -1, NodeState.PRE_OPERATIONAL, -1, -1, -1, -1, NodeState.OPERATIONAL, -1, -1, -1, -1]
    assert (decoder.heard_ns[3], decoder.heard_ns[8]) == (5000, 5000)
    for wrong in (b"\x06", b"\x85", b"", b"\x05\x05"):
        assert not decoder.take(new_message(0x700 + DRIVES[3], wrong))
    assert decoder.take(new_message(0x80 + DRIVES[4], bytes((0x30, 0x81, 1, 0, 0, 0, 0, 0))))
    assert decoder.take(new_message(0x80 + IMUS[4], bytes((0x30, 0x82, 1, 0, 0, 0, 0, 0))))
    assert decoder.error_codes == [0x2310, 0x2311, 0x2312, 0x2313, 0x8130, 0x2315]
    assert decoder.nmt[3] == NodeState.PRE_OPERATIONAL and decoder.refused == 4


def test_frames_of_this_side_are_neither_decoded_nor_refused():
    decoder = Decoder(settings(True))
    own = [0x000, 0x080, 0x700 + 100, *(0x200 + node for node in DRIVES), *(base + IMUS[3] for base in (0x580, 0x600))]
    assert all(decoder.take(new_message(each, bytes(3))) for each in own) and decoder.refused == 0
    for strange in (0x700 + 127, 0x180 + 1, 0x200 + IMUS[0], 0x7FF):
        assert not decoder.take(new_message(strange, bytes(8)))
    for flags in ({"is_extended_id": True}, {"is_remote_frame": True}, {"is_error_frame": True}):
        assert not decoder.take(can.Message(arbitration_id=0x080, **{"is_extended_id": False, **flags}))
    assert decoder.refused == 7


def test_the_truth_is_that_of_this_sync():
    decoder = Decoder(settings(True))
    assert np.isnan(decoder.truth).all() and len(decoder.truth) == 13
    truth = np.linspace(-1.0, 2.0, 19)
    decoder.begin(8)
    message = truth_message(truth, 8)
    assert message.is_extended_id and message.is_fd and len(message.data) == 64
    assert decoder.take(message)
    np.testing.assert_array_equal(decoder.truth, truth[:13].astype(np.float32))
    assert not decoder.take(truth_message(-truth, 7))
    np.testing.assert_array_equal(decoder.truth, truth[:13].astype(np.float32))
    assert decoder.refused == 1
