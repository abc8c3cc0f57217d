"""A command in a process of its own, with another that watches it: an FMU may crash, end its process, or never return."""

import atexit
import ctypes
import os
import signal
import sys
from contextlib import suppress
from types import FrameType

_PATIENCE_S = 5.0
"""How long a command may take to end after a signal [s]."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
_SET_PARENT_DEATH_SIGNAL = 1
_FAILED, _INTERRUPTED = 1, 130


def go_on_apart(what: str) -> None:
    """Go on in a child process. The present one passes on signals, waits, and says how the child ended if it did not itself.

    Args:
        what: is blamed, such as "the FMU rig.fmu".
    """
    orderly, report = os.pipe()
    parent, child = os.getpid(), os.fork()
    if child == 0:
        os.close(orderly)
        os.setpgid(0, 0)
        # Only Linux has it; elsewhere the child goes on if the present process is killed.
        with suppress(AttributeError):
            ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
        if os.getppid() != parent:
            os._exit(_FAILED)
        # What ends the process from compiled code leaves this out.
        atexit.register(os.write, report, b".")
        return
    os.close(report)
    os._exit(_watch(child, orderly, what))


def _watch(child: int, orderly: int, what: str) -> int:
    """Wait for the child, and return the exit status."""
    late = False

    def pass_on(number: int, frame: FrameType | None) -> None:
        del frame
        signal.setitimer(signal.ITIMER_REAL, _PATIENCE_S)
        with suppress(ProcessLookupError):
            os.kill(child, number)

    def end(number: int, frame: FrameType | None) -> None:
        nonlocal late
        del number, frame
        late = True
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)

    for number in _SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, pass_on)
    signal.signal(signal.SIGALRM, end)
    _, ended = os.waitpid(child, 0)
    status = os.waitstatus_to_exitcode(ended)
    if os.read(orderly, 1):
        return status
    if late:
        return _tell(f"{what} did not return from a call within {_PATIENCE_S:g} s, and its process was ended", _INTERRUPTED)
    if status in (-number for number in _SIGNALS):
        return -status + 128
    how = f"crashed with signal {-status}" if status < 0 else f"ended the process with status {status}"
    return _tell(f"{what} has {how}, and nothing is left of the run: try it with 'gough fmu validate'", _FAILED)


def _tell(text: str, status: int) -> int:
    with suppress(OSError):
        print(f"\ngough: {text}", file=sys.stderr, flush=True)
    return status
