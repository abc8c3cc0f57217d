"""Encoders: their words, and what they read against the geometry of play, steps and faults."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant.encoder_readings import ENCODER_STATE, MOST_FAULTS, encoder_state, read_encoders
from plant.encoders import PRESETS, EncoderFaultKind, EncoderModel, encoder_fault, load_encoder
from plant.errors import InputError, UnknownNameError

PERIOD = 1e-3
EXACT = EncoderModel("exact", absolute=True, resolution=0.0, backlash=0.0, zero=0.0)


def read(model, lengths, *faults, seed=0):
    """Readings, rates and home switches (N, 6) at lengths (N,) of every leg, or (N, 6)."""
    state, found = encoder_state(model, seed, PERIOD, map(encoder_fault, faults)), []
    for row in np.broadcast_to(np.reshape(lengths, (len(lengths), -1)), (len(lengths), 6)):
        readings, rates, home = np.empty(6), np.empty(6), np.empty(6, np.int64)
        read_encoders(state, row.copy(), readings, rates, home)
        found.append((readings, rates, home))
    return tuple(map(np.array, zip(*found, strict=True)))


def sweep(cycles=2000, size=0.01):
    return 0.5 + size * np.sin(2.0 * np.pi * np.arange(cycles) / 1000.0)


def test_without_encoders_nothing_is_read():
    readings, rates, home = read(None, sweep(3))
    assert np.isnan(readings).all() and np.isnan(rates).all() and (home == -1).all()


def test_an_ideal_encoder_reads_the_length_and_its_rate_with_the_lag_of_the_low_pass():
    lengths = 0.5 + 0.02 * PERIOD * np.arange(400.0)
    readings, rates, _ = read(PRESETS["ideal"], lengths)
    np.testing.assert_allclose(readings, np.repeat(lengths[:, None], 6, 1), rtol=1e-15)
    expected = 0.02 * (1.0 - np.exp(-PERIOD * np.arange(400.0) / 5e-3))
    np.testing.assert_allclose(rates[:, 3], expected, atol=1e-9)


def test_an_incremental_one_begins_at_nothing_and_an_absolute_one_near_the_truth():
    incremental, _, _ = read(PRESETS["incremental"], sweep())
    assert not incremental[0].any()
    np.testing.assert_allclose(incremental[:, 0], sweep() - 0.5, atol=10e-6 + 2.5e-6 + 1e-12)
    zeros = np.concatenate([read(PRESETS["absolute"], sweep(1), seed=seed)[0][0] - 0.5 for seed in range(200)])
    assert np.std(zeros) == pytest.approx(np.hypot(5e-6, 5e-6 / np.sqrt(12.0)), rel=0.08)


@given(
    steps=st.lists(st.floats(-1e-4, 1e-4), min_size=1, max_size=40),
    backlash=st.floats(0.0, 1e-4),
)
def test_the_encoders_end_of_a_play_stays_until_it_is_pushed(steps, backlash):
    lengths = 0.5 + np.cumsum([0.0, *steps])
    readings, _, _ = read(EncoderModel("loose", absolute=True, resolution=0.0, backlash=backlash, zero=0.0), lengths)
    place = readings[:, 2]
    assert (np.abs(place - lengths) <= 0.5 * backlash + 1e-12).all()
    for before, after, length in zip(place, place[1:], lengths[1:], strict=False):
        # Wherever it has moved, a flank pushes it.
        assert after == before or abs(abs(after - length) - 0.5 * backlash) < 1e-12


def test_a_reading_is_the_nearest_step():
    readings, _, _ = read(EncoderModel("coarse", absolute=True, resolution=1e-3, backlash=0.0, zero=0.0), sweep())
    assert np.abs(readings[:, 0] - sweep()).max() <= 5e-4 + 1e-12
    np.testing.assert_allclose(readings / 1e-3, np.rint(readings / 1e-3), atol=1e-9)


def test_noise_scale_and_dropouts_are_those_of_the_model():
    model = EncoderModel("bad", absolute=True, resolution=0.0, backlash=0.0, zero=0.0, noise=1e-5, dropout=0.2)
    readings, _, _ = read(model, np.full(5000, 0.5))
    assert np.isnan(readings).mean() == pytest.approx(0.2, abs=0.01)
    assert np.nanstd(readings) == pytest.approx(1e-5, rel=0.02)
    scaled = np.concatenate(
        [read(EncoderModel("s", True, 0.0, 0.0, scale=0.01, zero=0.0), [0.5], seed=n)[0][0] for n in range(99)]
    )
    assert np.abs(scaled / 0.5 - 1.0).max() <= 0.01 and np.std(scaled / 0.5) == pytest.approx(0.01 / np.sqrt(3.0), rel=0.1)


def test_a_home_switch_tells_the_side():
    model = EncoderModel("homed", switches=(0.505,), repeatability=0.0)
    _, _, home = read(model, sweep())
    np.testing.assert_array_equal(home[:, 0], sweep() >= 0.505)
    assert (home[:, 1:] == -1).all()


def test_the_same_seed_reads_the_same_and_another_one_does_not():
    model = EncoderModel("noisy", noise=1e-5)
    first, again, other = (read(model, sweep(50), seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        ("encoder-jumps:2,size_mm=0.5,at=1", lambda true, late: true + 5e-4 * late),
        ("encoder-creeps:2,size_mm_per_s=2,at=1,for=0.5", lambda true, late: true + 2e-6 * np.minimum(np.cumsum(late), 500)),
        ("encoder-reversed:2,at=1", lambda true, late: np.where(late, 2.0 * true[999] - true, true)),
        ("encoder-slips:2,size_percent=25,at=1", lambda true, late: np.where(late, 0.25 * true[999] + 0.75 * true, true)),
        ("encoder-frozen:2,at=1", lambda true, late: np.where(late, true[999], true)),
        ("encoder-dead:2,at=1,for=0.2", lambda true, late: np.where(late & (np.arange(2000) < 1200), np.nan, true)),
    ],
)
def test_a_fault_does_what_it_says(fault, expected):
    readings, _, _ = read(EXACT, sweep(), fault)
    late = np.arange(2000) >= 1000
    np.testing.assert_allclose(readings[:, 2], expected(sweep(), late), atol=1e-9)
    np.testing.assert_allclose(readings[:, 3], sweep(), rtol=1e-15)


def test_a_state_that_is_copied_goes_on_alike():
    model, lengths = EncoderModel("noisy", noise=1e-5), np.repeat(sweep(50)[:, None], 6, 1)
    state, rows = encoder_state(model, 3, PERIOD), []
    for n, row in enumerate(lengths):
        if n == 20:
            copy: np.ndarray = state.copy()
        rows.append((np.empty(6), np.empty(6), np.empty(6, np.int64)))
        read_encoders(state, row, *rows[-1])
    for n, row in enumerate(lengths[20:], 20):
        again = np.empty(6), np.empty(6), np.empty(6, np.int64)
        read_encoders(copy, row, *again)
        for part, other in zip(again, rows[n], strict=True):
            np.testing.assert_array_equal(part, other)
    assert copy.dtype == ENCODER_STATE


def test_a_file_changes_a_preset(tmp_path):
    path = tmp_path / "screw.toml"
    path.write_text('based_on = "absolute"\nresolution_um = 1\nbacklash_um = 30\nzero_um = 50\nswitches_m = [0.5, 0.51]\n')
    expected = EncoderModel("screw", True, 1e-6, 3e-5, zero=5e-5, switches=(0.5, 0.51))
    found = load_encoder(str(path))
    assert found is not None and found.name == "screw"
    for name in ("absolute", "resolution", "backlash", "zero", "switches"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name))
    assert load_encoder("none") is None and load_encoder("incremental") == PRESETS["incremental"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("resolution_mm = 1", "resolution_mm"),
        ('resolution_um = "fine"', "resolution_um of .* is 'fine'; it must be a number"),
        ("resolution_um = -1", "the resolution of an encoder is -1e-06; it must be finite and not negative"),
        ("absolute = 1", "absolute of .* is 1; it must be true or false"),
        ("switches_m = 0.5", "switches_m of .* is 0.5; it must be a list of lengths"),
        ("switches_m = [0.5, -1]", "the home switches are at"),
        ("dropout = 2", "they are below 1"),
        ('based_on = "none"', "is based on no encoder"),
        ('based_on = "absolut"', "no encoder 'absolut'.*did you mean 'absolute'"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused(tmp_path, content, message):
    path = tmp_path / "screw.toml"
    path.write_text(content)
    with pytest.raises((InputError, UnknownNameError), match=message):
        load_encoder(str(path))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("encoder-slip:3,size_percent=5", "no fault 'encoder-slip' of an encoder.*did you mean 'encoder-slips'"),
        ("encoder-slips:3", "needs its size: add size_percent=NUMBER"),
        ("encoder-slips:6,size_percent=5", "is for legs '6'; there are 0 to 5"),
        ("encoder-slips,size_percent=5", "is for legs ''"),
        ("encoder-slips:3,size_percent=much", "size_percent = 'much'"),
        ("encoder-dead:3,size_mm=1", "size_mm"),
        ("encoder-dead:3,for=0", "for_s = 0; it must be positive"),
        ("encoder-dead:3,at=-1", "at_s = -1; it must not be negative"),
    ],
)
def test_a_fault_that_is_not_meant_so_is_refused(text, message):
    with pytest.raises((InputError, UnknownNameError), match=message):
        encoder_fault(text)


def test_every_kind_of_fault_has_its_text_and_can_be_told_in_words():
    for kind in EncoderFaultKind:
        assert kind.text
        size = f",{kind.size}=1" if kind.size else ""
        found = encoder_fault(f"{kind.label}:0+5{size},at=2")
        assert (found.kind, found.legs, found.begin) == (kind, (0, 5), 2.0)
        assert found.size == pytest.approx(kind.factor)
        assert found.later(3.0).begin == 5.0


def test_too_many_faults_are_refused():
    with pytest.raises(InputError, match=f"at most {MOST_FAULTS}"):
        encoder_state(EXACT, 0, PERIOD, [encoder_fault("encoder-dead:1")] * (MOST_FAULTS + 1))
