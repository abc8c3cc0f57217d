"""The contract over every rig that there is, and over rigs that break it; recordings, and classes of one's own, as rigs."""

import ctypes
import json
import re
import subprocess
import sys
import threading
from dataclasses import asdict, replace
from importlib.metadata import version
from itertools import count

import can
import numpy as np
import pytest

from controller.safety.causes import Cause
from hil.command_line import main
from hil.loop.driver import FmuRig
from hil.loop.records import RECORD
from hil.realtime.scheduling import RealTimeSettings
from hil.recording.mcap import Recorder, read
from hil.recording.replay_rig import ENDED, FAILED, ReplayRig
from hil.rigs import ANSWERED, BRAKED, ENABLED, FAULTY, FOLLOWING, READY, SILENT, Identity, RigError, contract, new_feedback
from hil.rigs.by_name import python_rig
from hil.rigs.canopen.rig import CanopenRig
from hil.rigs.canopen.settings import DEFAULT_FILE, canopen_settings
from hil.rigs.clauses import CLAUSES
from hil.rigs.contract import check_rig, examine_rig
from hil.rigs.emulation import fault, new_emulated
from hil.rigs.template import TemplateRig
from hil.rigs.udp.datagrams import VERSION, WITH_LENGTHS
from hil.rigs.udp.emulator import new_udp_emulator
from hil.rigs.udp.link import new_link
from hil.rigs.udp.rig import UdpRig
from hil.runs.config import SimulationConfig
from hil.runs.executive import RunStoppedError, run
from hil.runs.prepare import prepared_loop, rig_of
from plant.errors import InputError, UnknownNameError
from plant.mechanism import load_spatial
from tests.hil.ports import free_port

PERIOD = 0.005
CONFIG = SimulationConfig(target="sines", duration=1.0, rate=500.0)
SETTINGS = RealTimeSettings(most_missed=2000)
HEXAPOD = load_spatial("hexapod")
on_virtual_time = pytest.mark.usefixtures("virtual_time")
ESTIMATES = ("position", "rotation", "covariance", "residuals", "conditioning", "lengths", "imus", "trusted", "sample_age")
FOLLOWED = ("reference", "command", "mode", "stop", "request")


def findings_between_processes(*rigs, **more):
    """What an examination finds in each of six trials; exchanges that take longer than their period are the machine's doing.

    A loaded machine may hold an emulator up in some. A rig that breaks the contract breaks it in all.
    """
    for _ in range(6):
        found = examine_rig(*rigs, **more)
        texts = [text for clause, texts in found.findings.items() if clause != "period" for text in texts]
        if not texts:
            break
    return texts


def template(rig_at=None):
    return TemplateRig(HEXAPOD, PERIOD, rig_at)


class emulator:  # noqa: N801
    """`gough emulate` in a process of its own, from when it listens."""

    def __init__(self, *options):
        command = [sys.executable, "-m", "hil.command_line", "emulate", "--control", f"127.0.0.1:{free_port()}", *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def __enter__(self):
        for line in self.process.stdout:
            if "listens" in line:
                return self.process
        raise AssertionError("the emulator has ended")

    def __exit__(self, *error):
        self.process.terminate()
        self.process.communicate(timeout=30.0)


# ------------------------------------------------------------------------------------------------------ rigs that there are


class Plant:
    """`FmuRig` with a loop of its own, whose periods pass with the exchanges."""

    command_delay = 0.0

    def __init__(self):
        self._prepared, self._rig = None, None

    def open(self):
        self._prepared = prepared_loop(SimulationConfig(rate=1.0 / PERIOD, target="hold"))
        self._loop = self._prepared.__enter__()
        self._rig = FmuRig(self._loop)

    def identify(self):
        return self._rig.identify()

    def arm(self):
        self._rig.arm()

    def exchange(self, command, request, feedback):
        status = self._rig.exchange(command, request, feedback)
        self._loop.state["time"]["cycle"] += 1
        return status

    def quick_stop(self):
        if self._rig is not None:
            self._rig.quick_stop()

    def close(self):
        if self._rig is not None:
            self._prepared.__exit__(None, None, None)
            self._rig = None


@on_virtual_time
def test_the_plant_keeps_the_contract():
    assert check_rig(Plant, PERIOD, mechanism=HEXAPOD) == []


@pytest.mark.slow
@on_virtual_time
def test_the_template_keeps_the_contract():
    found = examine_rig(template, PERIOD, beyond=10.0, absent=lambda: template("nowhere"), mechanism=HEXAPOD)
    assert found.all_findings() == []
    assert set(found.findings) == set(CLAUSES)
    assert found.identity.name == "template"
    assert 0.0 < found.exchange_us["p50"] <= found.exchange_us["p99"] <= found.exchange_us["max"]


@on_virtual_time
def test_nothing_is_asked_of_the_drives_unless_they_may_move():
    asked = []

    class Watched(TemplateRig):
        def arm(self):
            asked.append("arm")

        def exchange(self, command, request, feedback):
            asked.append((request, *command))
            return super().exchange(command, request, feedback)

    assert check_rig(lambda: Watched(HEXAPOD, PERIOD, None), PERIOD, moving=False) == []
    assert set(asked) == {(BRAKED, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)}


@pytest.mark.slow
@on_virtual_time
def test_a_recording_keeps_the_contract(tmp_path):
    path, _ = recording(tmp_path / "run.mcap", (), arm=False)
    found = examine_rig(
        lambda: ReplayRig(path, 0.002), 0.002, moving=False, absent=lambda: ReplayRig(path.with_name("none.mcap"), 0.002)
    )
    assert found.all_findings() == []


@pytest.mark.slow
@pytest.mark.parametrize(("drives", "beyond"), [("velocity", 10.0), ("position", None)])
def test_the_udp_rig_keeps_the_contract(drives, beyond):
    """A position loop has a following error, which is a fault of the drive, when it is told what no motor can do."""
    address, nowhere = (f"127.0.0.1:{free_port()}" for _ in range(2))
    period = 0.02
    with emulator("--at", address, "--rate", "50", "--drives", drives):
        rig, absent = lambda: UdpRig(address, period), lambda: UdpRig(nowhere, period)
        assert findings_between_processes(rig, period, beyond=beyond, absent=absent) == []


@pytest.fixture
def multicast(tmp_path):
    """Settings of a CANopen bus of its own, patient with a loaded machine."""
    path = tmp_path / "rig.toml"
    text = DEFAULT_FILE.read_text().replace("43113", str(free_port())).replace('eds = "', f'eds = "{DEFAULT_FILE.parent}/')
    for name, value in (("heartbeat_timeout", "0.1 "), ("command_timeout", "0.1 "), ("silence", "0.35 ")):
        assert f"{name} = {value}" in text
        text = text.replace(f"{name} = {value}", f"{name} = 1.0 ")
    path.write_text(text)
    bus = canopen_settings(path).bus
    try:
        with bus.opened() as one, bus.opened() as other:
            one.send(can.Message(arbitration_id=0x123))
            if other.recv(0.5) is None:
                pytest.skip("multicast frames do not arrive on this machine")
    except (can.CanError, OSError) as error:
        pytest.skip(f"multicast is impossible here: {error}")
    return path


@pytest.mark.slow
def test_the_canopen_rig_keeps_the_contract(multicast):
    settings = canopen_settings(multicast)
    # On a loaded machine two processes need a while to take turns.
    period = 0.02
    with emulator("--bus", "canopen", "--at", str(multicast), "--rate", "50"):
        assert findings_between_processes(lambda: CanopenRig(settings, period), period, beyond=10.0) == []


# ------------------------------------------------------------------------------------------------------ rigs that break it


class RaisesInQuickStop(TemplateRig):
    def quick_stop(self):
        if self._hardware is None:
            raise ConnectionError("the port is closed")


class GoesBack(TemplateRig):
    exchanges = 0

    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        self.exchanges += 1
        if self.exchanges == 30:
            feedback["sequence"][3] -= 5
        return status


class TimeGoesBack(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        feedback["sample_ns"] *= -1
        return status


class StandsStill(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        feedback["sequence"][2] = 7
        return status


class IsSlow(TemplateRig):
    def exchange(self, command, request, feedback):
        contract.time.sleep(1.5 * PERIOD)
        return super().exchange(command, request, feedback)


class HearsNothingForLong(TemplateRig):
    """Whatever holds this machine up for 40 ms in the 130th exchange, the drives' watchdog strikes."""

    count = 0

    def exchange(self, command, request, feedback):
        self.count += 1
        if self.count == 130:
            contract.time.sleep(0.04)
        status = super().exchange(command, request, feedback)
        if self.count >= 130:
            feedback["drive"], feedback["drive_code"] = FAULTY, 0x8130
        return status


class Ignores(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        feedback["drive"][4] = READY
        return status


class IgnoresQuickStop(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        feedback["drive"] = READY if request == BRAKED else FOLLOWING
        return status


class ChangesDtype(TemplateRig):
    def exchange(self, command, request, feedback):
        feedback.dtype = np.dtype([("measurement", np.float32, (3, 7, 3))])
        return super().exchange(command, request, feedback)


class WritesBeyond(TemplateRig):
    def exchange(self, command, request, feedback):
        ctypes.memset(feedback["measurement"].ctypes.data + feedback.dtype.itemsize, 0, 8)
        return super().exchange(command, request, feedback)


class LeavesAThread(TemplateRig):
    ended = threading.Event()

    def open(self):
        super().open()
        threading.Thread(target=self.ended.wait, args=(30.0,), name="reader", daemon=True).start()


class ChangesCommands(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        command += 1.0
        return status


class SendsOtherwise(TemplateRig):
    def exchange(self, command, request, feedback):
        return super().exchange(0.5 * command, request, feedback)


class HasNoLimit(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        feedback["sent"] = np.nan_to_num(command) if request == ENABLED else 0.0
        return status


class TurnsTheWrongWay(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        self._hardware.commands[1] *= -1.0
        feedback["sent"] = command if request == ENABLED else 0.0
        return status


class IsInG(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        feedback["measurement"][1] /= 9.81
        return status


class HasHalfASample(TemplateRig):
    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        feedback["measurement"][0, 5, 1] = np.nan
        return status


class Raises(TemplateRig):
    def exchange(self, command, request, feedback):
        raise TimeoutError("the port is slow")


class Fails(TemplateRig):
    failure = "the amplifier is hot"

    def exchange(self, command, request, feedback):
        return 5


class IsSilent(TemplateRig):
    def exchange(self, command, request, feedback):
        return SILENT


class ReturnsNothing(TemplateRig):
    def exchange(self, command, request, feedback):
        super().exchange(command, request, feedback)


class CannotBeOpened(TemplateRig):
    def open(self):
        raise FileNotFoundError("/dev/ttyUSB0")


class HasNoWords(TemplateRig):
    def open(self):
        raise RigError


class IsNobody(TemplateRig):
    def identify(self):
        return "a rig"


class OpensOnce(TemplateRig):
    openings = count()

    def open(self):
        if next(self.openings):
            raise RigError("the port is taken")
        super().open()


class DelaysForLong(TemplateRig):
    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.command_delay = 3.0


@pytest.mark.slow
@on_virtual_time
@pytest.mark.parametrize(
    "kind, clause, message",
    [
        (RaisesInQuickStop, "stops at any time", "quick_stop before open raised ConnectionError: the port is closed"),
        (GoesBack, "order in time", "number of IMU 3's samples went back in exchange 30"),
        (TimeGoesBack, "order in time", "time of IMU 0's samples went back"),
        (StandsStill, "sample age", "IMU 2 has no new sample in 4 exchanges"),
        (IsSlow, "period", "longer than the period of 5 ms"),
        (
            HearsNothingForLong,
            "drives",
            r"faulty.*0x8130[^\0]*busy elsewhere, for up to 40 ms between .* watchdog",
        ),
        (Ignores, "drives", "Asked to follow, the drives are following, .*, ready, following after 20 exchanges"),
        (IgnoresQuickStop, "drives", "Asked to stop quickly, the drives are following"),
        (ChangesDtype, "exchanges", "exchange raised AttributeError: .*not writable"),
        (WritesBeyond, "feedback", "wrote beyond the feedback"),
        (LeavesAThread, "threads", r"Threads are left when it is closed \(reader\)"),
        (ChangesCommands, "exchanges", "exchange changed the commands"),
        (SendsOtherwise, "sent", "Drive 0 was commanded 0.001 m/s, and 0.0005 m/s"),
        (HasNoLimit, "sent", "A command of 10 m/s was sent as it is"),
        (TurnsTheWrongWay, "motion", "Leg 1 moved by -0.*check its sign"),
        (IsInG, "feedback", "IMU 0 reads 1 m/s.2 at rest"),
        (HasHalfASample, "feedback", "IMU 5 .*axes that are not finite"),
        (Raises, "exchanges", "exchange raised TimeoutError: the port is slow"),
        (Fails, "exchanges", "Exchange 1 failed with status 5: the amplifier is hot"),
        (IsSilent, "exchanges", "100 of 100 exchanges on the brakes brought no answer"),
        (ReturnsNothing, "exchanges", "exchange returned None"),
        (CannotBeOpened, "opens", "open raised FileNotFoundError: /dev/ttyUSB0; it must raise a RigError"),
        (HasNoWords, "opens", "open raised RigError without a message"),
        (IsNobody, "identifies", "identify returned 'a rig'"),
        (OpensOnce, "opens again", "open refused: the port is taken"),
        (DelaysForLong, "interface", "Its command_delay is 3.0"),
    ],
)
def test_what_breaks_the_contract_is_found(kind, clause, message):
    try:
        found = examine_rig(lambda: kind(HEXAPOD, PERIOD, None), PERIOD, beyond=10.0)
    finally:
        if kind is LeavesAThread:
            LeavesAThread.ended.set()
    texts = "\n".join(found.findings[clause])
    assert re.search(message, texts), found.findings


@on_virtual_time
def test_a_rig_that_is_not_there_must_say_so():
    (text,) = check_rig(template, PERIOD, moving=False, absent=template)
    assert text == "A rig that is not there is opened and identified as if it were."
    (text,) = check_rig(template, PERIOD, moving=False, absent=lambda: CannotBeOpened(HEXAPOD, PERIOD, None))
    assert "raises FileNotFoundError: /dev/ttyUSB0; it must raise a RigError" in text


def test_what_is_no_rig():
    (text,) = check_rig(lambda: Identity("something"), PERIOD)
    assert text == "It lacks open, identify, arm, exchange, quick_stop, close, command_delay."


# ------------------------------------------------------------------------------------------------------------ recordings


FAULTS = ("imu-dead:3,at=0.4,for=0.2", "bus-drops,size=0.02", "bus-repeats,size=0.02")


def recording(path, faults=None, **changes):
    """A whole run without missed periods, of the plant or, with faults, of an emulated rig on UDP, in memory; its records."""
    with prepared_loop(replace(CONFIG, **changes), np.zeros(4000, RECORD)) as loop:
        if faults is not None:
            rig = new_emulated(loop.mechanism, 1_000_000, 0, [fault(text) for text in faults])
            version = WITH_LENGTHS if "lengths" in changes else VERSION
            loop.udp = new_link()
            loop.emulator = new_udp_emulator(loop.fmu, loop.imu, loop.encoders, rig, 1, version=version)
            loop.udp.socket["session"], loop.udp.socket["version"], loop.udp.socket["timeout_ns"] = 1, version, 1_000_000
            loop.parameters["load"]["command_delay"] = 1.0 / CONFIG.rate
        assert loop.follow(loop.end) == Cause.END_OF_MOTION
        records = loop.records[: int(loop.state["time"]["cycle"])].copy()
        write(path, loop, records, rig="fmu" if faults is None else "udp")
    return path, records


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return recording(tmp_path_factory.mktemp("recorded") / "run.mcap", ())


def write(path, loop, records, **changes):
    config = {**asdict(CONFIG), "mechanism_name": loop.mechanism.name, "version": version("gough"), "run": "1", **changes}
    recorder = Recorder(path, {"config": config, "parameters": loop.parameters, "reference": loop.segments}, 0)
    recorder.write(records)
    recorder.close()


def replayed(path, rig=None, **changes):
    """The same run on a recording: cause, records."""
    config = replace(CONFIG, rig="replay", rig_at=str(path), **changes)
    rig = rig or ReplayRig(path, 1.0 / config.rate, HEXAPOD)
    with prepared_loop(config, np.zeros(4000, RECORD)) as loop:
        rig.open()
        loop.parameters["load"]["command_delay"] = rig.command_delay
        cause = loop.follow(loop.end, rig)
        return cause, loop.records[: int(loop.state["time"]["cycle"])].copy()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "changes"),
    [
        (None, {}),
        ((), {}),
        (FAULTS, {}),
        ((*FAULTS, "encoder-jumps:2,size_mm=2,at=0.3"), {"lengths": "incremental", "fusion": "whole"}),
    ],
    ids=["fmu", "udp", "faults", "lengths"],
)
def test_a_replayed_run_is_the_recorded_one_bit_for_bit(faults, changes, tmp_path):
    path, records = recording(tmp_path / "run.mcap", faults, **changes)
    if faults:
        assert 5 < np.count_nonzero(records["silent"]) < 100
        assert records["sample_age"][:, 3].max() > 80
        assert len(np.unique(records["imus"])) > 1
    cause, again = replayed(path, **changes)
    assert cause == Cause.END_OF_MOTION
    assert len(again) == len(records) > 600
    for name in (*ESTIMATES, *FOLLOWED, "sample_ns", "drive", "sent", "truth", "silent", "refused", "event_cause"):
        assert again[name].tobytes() == records[name].tobytes(), name


@pytest.mark.slow
def test_a_replay_on_the_clock(recorded, tmp_path):
    path, records = recorded
    config = replace(CONFIG, rig="replay", rig_at=str(path))
    # A period that is missed now leads to other estimates. On a busy machine one may be missed early: try again.
    for number in range(10):
        file = tmp_path / f"again-{number}.mcap"
        try:
            summary = run(config, SETTINGS, file)
        except RunStoppedError:
            # After a missed period the recorded drives may not do what is asked of them now; nothing else excuses a stop.
            assert read(file).records["missed"].any()
            upto = 0
            continue
        assert summary["cause"] == "end of the motion"
        assert summary["identity"]["parts"]["rig"] == "udp"
        again = read(file).records
        gaps = np.flatnonzero(again["missed"])
        upto = int(gaps[0]) if len(gaps) else len(records)
        if upto > 50:
            break
    assert upto > 50
    for name in (*ESTIMATES, *FOLLOWED):
        assert again[name][:upto].tobytes() == records[name][:upto].tobytes(), name


@pytest.mark.slow
def test_the_end_of_the_recording_ends_the_run(recorded, tmp_path):
    path, records = recorded
    cause, again = replayed(path, duration=0.5, arm=False)
    assert cause == Cause.END_OF_MOTION
    assert len(again) < len(records)
    short = tmp_path / "short.mcap"
    with prepared_loop(CONFIG) as loop:
        write(short, loop, records[:300])
    cause, again = replayed(short)
    assert cause == Cause.RIG_FAILED
    np.testing.assert_array_equal(again["position"][:300], records["position"][:300])
    with pytest.raises(RunStoppedError, match=r"the rig reports failure \(2\): the recording has come to its end"):
        run(replace(CONFIG, rig="replay", rig_at=str(short)), SETTINGS)


def test_missed_periods_and_consecutive_files(recorded, tmp_path):
    path, records = recorded
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    later = records[102:].copy()
    later["missed"][0] = 2
    later["status"][5], later["silent"][7] = Cause.RIG_FAILED, 3
    with prepared_loop(CONFIG) as loop:
        write(first, loop, records[:100])
        write(second, loop, later)
        write(tmp_path / "other.mcap", loop, later, run="2")
        write(tmp_path / "empty.mcap", loop, records[:0])
    rig = ReplayRig([second, first], 0.002, HEXAPOD)
    rig.open()
    feedback, statuses, numbers = new_feedback()[()], [], []
    for _ in range(112):
        statuses.append(rig.exchange(np.zeros(6), BRAKED, feedback))
        numbers.append(int(feedback["sequence"][0]))
    assert statuses[:100] == [ANSWERED] * 100
    assert statuses[100:] == [SILENT] * 2 + [ANSWERED] * 5 + [FAILED, ANSWERED, SILENT] + [ANSWERED] * 2
    assert numbers[99:103] == [100, 100, 100, 101]
    np.testing.assert_array_equal(feedback["measurement"][1], records[111]["specific_force"])
    rig.close()
    assert rig.exchange(np.zeros(6), BRAKED, feedback) == ENDED
    for paths, message in (
        ([first, tmp_path / "other.mcap"], "are of different runs"),
        ([second], "does not begin with the first cycle"),
        ([tmp_path / "empty.mcap"], "holds no cycle"),
        ([tmp_path / "none.mcap"], "there is no recording at"),
    ):
        with pytest.raises(RigError, match=message):
            ReplayRig(paths, 0.002).open()
    with pytest.raises(RigError, match="was recorded at 500 Hz and cannot be replayed at 1000 Hz"):
        ReplayRig(path, 0.001).open()
    with pytest.raises(RigError, match="on the mechanism hexapod, not on"):
        ReplayRig(path, 0.002, replace(HEXAPOD, name="another")).open()
    with pytest.raises(RigError, match="not open"):
        ReplayRig(path, 0.002).identify()
    with pytest.raises(InputError, match="a replay needs its recording"):
        rig_of(replace(CONFIG, rig="replay"))


# ------------------------------------------------------------------------------------------------------- rigs of one's own


@pytest.mark.slow
def test_the_template_runs_on_the_clock():
    config = SimulationConfig(target="sines", duration=1.0, rate=200.0, imu="ideal", rig="python:hil.rigs.template:TemplateRig")
    summary = run(config, SETTINGS)
    assert summary["cause"] == "end of the motion"
    assert summary["identity"]["name"] == "template"
    assert summary["errors_m"]["known"] > 200
    assert summary["errors_m"]["estimation"] < 1e-3


OWN = """
from hil.rigs.template import TemplateRig
class Own(TemplateRig): pass
class Half:
    def __init__(self, mechanism, period, rig_at): pass
    def open(self): pass
    exchange = close = open
class NoDelay(Half):
    identify = arm = quick_stop = Half.open
class Greedy(Own):
    def __init__(self, mechanism): pass
class Refuses(Own):
    def __init__(self, mechanism, period, rig_at):
        from hil.rigs import RigError
        raise RigError(f"no rig at {rig_at}")
something = 3
"""


def test_a_class_in_the_present_folder(tmp_path, monkeypatch):
    (tmp_path / "own_rig.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    path = list(sys.path)
    rig = rig_of(SimulationConfig(rig="python:own_rig:Own", rig_at="here", rate=250.0))
    assert (type(rig).__name__, rig.command_delay, rig._rig_at, rig._mechanism.name) == ("Own", 0.004, "here", "hexapod")
    assert sys.path == path
    (tmp_path / "broken_rig.py").write_text("import no_such_library\n")
    (tmp_path / "worse_rig.py").write_text("1 / 0\n")
    for name, error, message in (
        (
            "nothing",
            InputError,
            "'nothing' is not the name of a rig in Python: give module and class, such as python:my_rig:MyRig",
        ),
        ("own_rig:", InputError, "is not the name of a rig"),
        (":Own", InputError, "is not the name of a rig"),
        ("no_such_rig:Rig", UnknownNameError, "there is no module no_such_rig: start gough in its folder"),
        ("own_rig.deeper:Rig", UnknownNameError, "there is no module own_rig.deeper"),
        ("broken_rig:Rig", InputError, "module broken_rig cannot be imported: No module named 'no_such_library'"),
        ("worse_rig:Rig", InputError, "module worse_rig cannot be imported: ZeroDivisionError"),
        ("own_rig:Owm", UnknownNameError, "module own_rig has no class Owm; there is TemplateRig, Own"),
        ("own_rig:something", InputError, "something of module own_rig is not a class"),
        ("own_rig:Half", InputError, "Half of module own_rig is not a rig: it lacks identify, arm, quick_stop"),
        ("own_rig:NoDelay", InputError, "it lacks command_delay"),
        ("own_rig:Greedy", InputError, "cannot be called with mechanism, period and rig_at: TypeError"),
        ("own_rig:Refuses", RigError, "no rig at there"),
    ):
        with pytest.raises(error, match=message):
            python_rig(name, HEXAPOD, PERIOD, "there")
    with pytest.raises(UnknownNameError, match="no rig 'own'; there are fmu, udp, canopen, replay and python:MODULE:CLASS"):
        SimulationConfig(rig="own")


# ------------------------------------------------------------------------------------------------------------ command line


@on_virtual_time
def test_check_rig_on_the_command_line(tmp_path, capsys):
    path = tmp_path / "found.json"
    rig = ["check-rig", "--rig", "python:hil.rigs.template:TemplateRig"]
    assert main([*rig, "--json", str(path)]) == 0
    output = capsys.readouterr().out
    assert "0 findings, and nothing was moved" in output
    found = json.loads(path.read_text())
    assert (found["moved"], found["identity"]["name"]) == (False, "template")
    assert not any(found["findings"].values())
    assert "motion" not in found["findings"]
    assert main([*rig, "--rig-at", "nowhere", "--json", str(path)]) == 1
    output = capsys.readouterr().out
    assert "open refused: there is no hardware at nowhere" in output
    assert json.loads(path.read_text())["findings"]["opens"]
    for arguments, message in (
        (["check-rig", "--rig", "fmu"], "the FMU plant is no rig of its own"),
        ([*rig, "--beyond", "3"], "needs --move"),
        (["check-rig", "--rig", "python:none:None"], "there is no module none"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
