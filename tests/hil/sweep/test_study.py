"""Studies: what varies, at which points, and what a file may say."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import qmc

from hil.runs.config import SimulationConfig
from hil.sweep.study import METHODS, Factor, Sampling, Study, read_study
from plant.errors import GoughError, InputError
from plant.fmu.settings import Setting

SEEDS = Factor("run.seed", (0, 1, 2))
GAIN = Factor("mechanism.control.proportional", (), 40.0, 80.0)
MASS = Factor("plant.payload.mass", (), 5.0, 15.0)


@pytest.fixture
def written(tmp_path: Path):
    """Writes a study's file."""

    def write(text: str) -> Path:
        path = tmp_path / "imu_grade.toml"
        path.write_text(text)
        return path

    return write


def test_values_are_crossed_and_ranges_are_sampled() -> None:
    study = Study((SEEDS, GAIN, Factor("run.imu", ("ideal", "mpu9150"))), sampling=Sampling(count=4))
    points = study.points()
    assert len(points) == study.size == 4 * 3 * 2
    assert len({point["mechanism.control.proportional"] for point in points}) == 4
    assert list(points[0]) == ["run.seed", "mechanism.control.proportional", "run.imu"]
    # Samples are the outer loop: what is crossed changes first.
    assert [point["run.imu"] for point in points[:4]] == ["ideal", "mpu9150", "ideal", "mpu9150"]
    assert len({point["mechanism.control.proportional"] for point in points[:6]}) == 1


def test_a_value_of_the_plant_may_have_a_time(written) -> None:
    text = '[plant]\n"friction.viscous@1" = 90\n[vary]\nplant."payload.mass@3.5" = [8.1, 9.1]\n'
    study = read_study(written(text))
    assert study.config_at(study.points()[1]).settings == (
        Setting("friction.viscous", (90.0,), 1.0), Setting("payload.mass", (9.1,), 3.5),
    )  # fmt: skip
    with pytest.raises(InputError, match=r"input 'payload.mas'; did"):
        read_study(written(text.replace("mass", "mas")))


@pytest.mark.parametrize(
    ("values", "plain"),
    [
        (np.linspace(0.0, 1.0, 3), (0.0, 0.5, 1.0)),
        (tuple(np.arange(3)), (0, 1, 2)),
        ([np.float32(0.5), 1], (0.5, 1)),
        (np.array(["a", "b"]), ("a", "b")),
        ((np.True_, False), (True, False)),
        (np.eye(2), ([1.0, 0.0], [0.0, 1.0])),
        (((np.int64(1), 2), [np.int32(3)]), ([1, 2], [3])),
        (range(2), (0, 1)),
    ],
)
def test_values_of_numpy_are_plain_ones(values: Any, plain: tuple[Any, ...]) -> None:
    found = Factor("x", values).values
    assert found == plain
    assert json.loads(json.dumps(found)) == list(plain)


def test_values_that_no_table_can_have_are_refused() -> None:
    with pytest.raises(InputError, match=r"x has the value .*Path.*give numbers, switches, texts or lists"):
        Factor("x", (Path("a.toml"),))


def test_without_a_range_nothing_is_sampled() -> None:
    assert [point["run.seed"] for point in Study((SEEDS,)).points()] == [0, 1, 2]


@pytest.mark.parametrize("method", METHODS)
def test_samples_fill_the_range_evenly_and_follow_the_seed(method: str) -> None:
    study = Study((GAIN, MASS), sampling=Sampling(method, 64, seed=5))
    points = study.points()
    values = np.array([list(point.values()) for point in points])
    assert len(points) == study.size == (64 * 4 if method == "saltelli" else 64)
    assert (values >= (40.0, 5.0)).all()
    assert (values <= (80.0, 15.0)).all()
    assert points == study.points()
    assert points != Study((GAIN, MASS), sampling=Sampling(method, 64, seed=6)).points()
    # Random points have a discrepancy of about 0.01.
    unit = (values - (40.0, 5.0)) / (40.0, 10.0)
    assert qmc.discrepancy(unit[np.unique(unit, axis=0, return_index=True)[1]]) < 5e-3


@given(st.floats(0.0, 1.0), st.floats(1e-6, 1e3), st.floats(1.001, 1e3))
def test_a_range_has_its_ends_and_a_logarithmic_one_its_geometric_mean(share: float, low: float, times: float) -> None:
    even, logarithmic = (Factor("run.rate", (), low, low * times, each) for each in (False, True))
    for factor in (even, logarithmic):
        assert factor.at(0.0) == low
        assert factor.at(1.0) == pytest.approx(low * times, rel=1e-12)
        assert low * (1.0 - 1e-12) <= factor.at(share) <= low * times * (1.0 + 1e-12)
    assert logarithmic.at(0.5) == pytest.approx(np.sqrt(low * low * times), rel=1e-9)
    assert even.at(0.5) == pytest.approx((low + low * times) / 2.0, rel=1e-9)


def test_a_file_says_all_of_it(written) -> None:
    study = read_study(
        written(
            """
            name = "Grade"
            [run]
            duration = 2
            imus = "legs"
            [mechanism.control]
            integral = 150.0
            [plant]
            payload.mass = 12
            [vary]
            run.imu = ["ideal", "mpu9150"]
            run.seed = { seeds = 3 }
            run.joint_error = { from = 0.0, to = 2e-4, steps = 3 }
            mechanism.control.proportional = { from = 40.0, to = 80.0 }
            plant.friction.coulomb = { from = 1.0, to = 100.0, logarithmic = true }
            [sampling]
            method = "latin-hypercube"
            count = 5
            seed = 7
            [measure]
            figures = ["tracking.position_rms"]
            """
        )
    )
    assert (study.name, study.size) == ("Grade", 2 * 3 * 3 * 5)
    assert study.sampling == Sampling("latin-hypercube", 5, 7)
    assert study.figures == ("tracking.position_rms",)
    names = [factor.name for factor in study.factors]
    assert names == [
        "run.imu", "run.seed", "run.joint_error", "mechanism.control.proportional", "plant.friction.coulomb",
    ]  # fmt: skip
    assert study.factors[2].values == (0.0, 1e-4, 2e-4)
    point = study.points()[-1]
    config = study.config_at(point)
    assert (config.imu, config.seed, config.joint_error, config.duration) == ("mpu9150", 2, 2e-4, 2.0)
    assert config.imus == (0, 1, 2, 3, 4, 5)
    assert [(each.name, each.value) for each in config.settings] == [
        ("payload.mass", (12.0,)),
        ("friction.coulomb", (point["plant.friction.coulomb"],)),
    ]
    assert study.mechanism_at(point) == {
        "control.integral": 150.0,
        "control.proportional": point["mechanism.control.proportional"],
    }


def test_files_are_looked_for_beside_the_study(written, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.toml").write_text('based_on = "hexapod"\n')
    (tmp_path / "wave.csv").write_text("")
    (tmp_path / "own.py").write_text("def figure(result):\n    return 1.0\n")
    path = written(
        '[run]\ntarget = "wave.csv"\n[vary]\nrun.mechanism = ["hexapod", "mine.toml"]\n[measure]\nfunction = "own.py:figure"\n'
    )
    monkeypatch.chdir("/")
    study = read_study(path)
    assert study.run.target == str(tmp_path / "wave.csv")
    assert study.factors[0].values == ("hexapod", str(tmp_path / "mine.toml"))
    assert study.function is not None
    assert study.function.figures(None) == {"figure": 1.0}


def test_what_does_not_vary_is_that_of_a_simulation() -> None:
    assert Study((SEEDS,)).config_at({"run.seed": 2}) == SimulationConfig(seed=2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "nothing varies"),
        ("speed = 1\n", "no entry 'speed'"),
        ("vary = 1\n", "vary = 1 must be a table [vary]"),
        ("[varry]\nrun.seed = [1]\n", "did you mean 'vary'?"),
        ("name = 3\n[vary]\nrun.seed = [1]\n", "name = 3 must be text"),
        ("[vary]\nrun.seed = 3\n", "does not vary"),
        ("[vary]\nrun.seed = []\n", "does not vary"),
        ("[vary]\nrun.seed = { seeds = 0 }\n", "seeds = 0 must be a whole number, 1 to 10000000"),
        ("[vary]\nrun.seed = { seeds = 100000000 }\n", "seeds = 100000000 must be a whole number, 1 to 10000000"),
        ("[vary]\nrun.seed = { from = 0, to = 9 }\n", "a seed, a whole number, and has no range: give { seeds = 10 }"),
        ("[vary]\nrun.seed = { seeds = 2, from = 1 }\n", "stand alone"),
        ("[vary]\nrun.seed = { seeds = 2.5 }\n", "seeds = 2.5 must be a whole number"),
        ("[vary]\nrun.rate = { seeds = 2 }\n", "run.rate is no seed"),
        ("[vary]\nrun.rate = { from = 100.0, upto = 200.0 }\n", "no entry 'upto'"),
        ("[vary]\nrun.rate = { from = 100.0, to = 200.0, step = 3 }\n", "did you mean 'steps'?"),
        ("[vary]\nrun.rate = { from = 100.0, to = 200.0, logarithmic = 1 }\n", "logarithmic = 1 must be true or false"),
        ('[vary]\nrun.seed = [1, "two"]\n', "run.seed has values of several kinds, [1, 'two']"),
        ("[vary]\nrun.magnetometer = [true, 0]\n", "several kinds"),
        ("[vary]\nrun.seed = [1, 2, 1]\n", "run.seed has the value 1 twice"),
        ("[vary]\nrun.joint_error = [nan]\n", "run.joint_error has the value nan"),
        ("[vary]\nrunn.seed = [1]\n", "did you mean 'run'?"),
        ("[vary]\nrun.speed = [1, 2]\n", "no entry 'speed'"),
        ("[vary]\nrun.joint_eror = [0.0]\n", "did you mean 'joint_error'?"),
        ("[vary]\nrun.arm = [true, false]\n", "no entry 'arm'"),
        ("[vary]\nspeed = [1, 2]\n", "run.FIELD"),
        ("[vary]\nrun.rate = { from = 1.0 }\n", "from and to"),
        ("[vary]\nrun.rate = { from = 200.0, to = 100.0 }\n", "goes up"),
        ("[vary]\nrun.rate = { from = 1.0, to = nan }\n", "finite"),
        ("[vary]\nrun.rate = { from = 0.0, to = 1.0, logarithmic = true }\n", "must be positive"),
        ("[vary]\nrun.rate = { from = 1.0, to = 2.0, steps = 1 }\n", "a whole number, 2 to 10000000"),
        ('[vary]\nrun.rate = { from = "a", to = 2.0 }\n', "run.rate"),
        ("[sampling]\ncount = 1\n[vary]\nrun.seed = [1]\n", "2 to"),
        ("[sampling]\ncount = 100\n[vary]\nrun.seed = [1]\n", "64 or 128"),
        ('[sampling]\nmethod = "dice"\n[vary]\nrun.seed = [1]\n', "sobol"),
        ('[sampling]\nmethod = "saltelli"\n[vary]\nrun.seed = [1]\n', "samples ranges"),
        ("[sampling]\nseed = -1\n[vary]\nrun.seed = [1]\n", "seed is -1"),
        ("[sampling]\ncount = 64.0\n[vary]\nrun.seed = [1]\n", "count = 64.0 must be a whole number"),
        ('[sampling]\nmethod = "saltely"\n[vary]\nrun.seed = [1]\n', "did you mean 'saltelli'?"),
        ('[run]\nrate = "fast"\n[vary]\nrun.seed = [1]\n', "run.rate = 'fast' must be a number"),
        ("[run]\nseed = 1.5\n[vary]\nrun.rate = [100]\n", "run.seed = 1.5 must be a whole number"),
        ("[run]\nmagnetometer = 1\n[vary]\nrun.seed = [1]\n", "must be true or false"),
        ("[run]\ntarget = 7\n[vary]\nrun.seed = [1]\n", "run.target = 7 must be text"),
        ("[run]\nduratoin = 7\n[vary]\nrun.seed = [1]\n", "did you mean 'duration'?"),
        ('[plant]\npayload.mass = "heavy"\n[vary]\nrun.seed = [1]\n', "plant.payload.mass = 'heavy' must be a finite number"),
        ('[measure]\nfigures = "estimation.position_rms"\n[vary]\nrun.seed = [1]\n', "must be a list of texts"),
        ('[measure]\nfunctoin = "a.py:f"\n[vary]\nrun.seed = [1]\n', "did you mean 'function'?"),
        ('model = "own.py:f"\n[run]\nrate = 100\n[vary]\nx = [1]\n', "leave out [run]"),
        ("[run]\nrate = 1e9\n[vary]\nrun.seed = [1]\n", "4000"),
        ('[run]\nfusion = "cold"\n[vary]\nrun.seed = [1]\n', "no fusion"),
        ('[measure]\nfunction = "nothing.py:f"\n[vary]\nrun.seed = [1]\n', "nothing.py"),
        ('model = "f"\n[vary]\nx = [1]\n', "FILE.py:FUNCTION"),
    ],
)
def test_a_wrong_file_gets_one_line_that_names_it(written, text: str, said: str) -> None:
    with pytest.raises(GoughError) as error:
        read_study(written(text))
    message = str(error.value)
    assert "imu_grade.toml" in message
    assert said in message
    assert "\n" not in message


def test_a_factor_varies_once_and_points_are_limited() -> None:
    with pytest.raises(InputError, match="twice"):
        Study((SEEDS, SEEDS))
    with pytest.raises(InputError, match="vary less"):
        Study((Factor("run.seed", tuple(range(4000))), Factor("run.rate", tuple(range(4000))))).points()


def test_faults_of_imus_are_values_as_one_text() -> None:
    turned, slow = "imu-turn:6,axis=z,size_deg=3", "imu-clock:3,size_percent=-50"
    study = Study((Factor("run.faults", ("", turned, f"{turned} {slow}")),))
    assert [study.config_at(point).faults for point in study.points()] == [(), (turned,), (turned, slow)]
    with pytest.raises(InputError, match="needs one of size_deg"):
        [study.config_at(point) for point in Study((Factor("run.faults", ("imu-turn:6,axis=z",)),)).points()]
