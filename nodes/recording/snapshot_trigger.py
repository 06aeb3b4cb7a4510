"""Trigger of `mirrorwave bag snapshot`: a locked file in the graph's directory, SIGUSR1, and the answer in the file.

The file `snapshot-<pid>.json` is locked as long as its recorder lives, so that no signal can reach another process that
was given the same number.
"""

from __future__ import annotations

import fcntl
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from msgs.bus.zmq import make_run_dir
from msgs.files.whole_files import no_link

_POLL_S = 0.02


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """Result of one trigger."""

    path: str = ""
    messages: int = 0
    span_s: float = 0.0
    #: Messages that were sent in that time and never reached the recorder.
    lost: int = 0
    #: Empty where the snapshot was written.
    error: str = ""


class State(msgspec.Struct, frozen=True, kw_only=True):
    """Content of the file."""

    pid: int
    #: Being written now.
    busy: bool = False
    answers: int = 0
    last: Snapshot = Snapshot()


class TriggerFile:
    """The recorder's side: says that it is there, and what became of each trigger.

    Raises `OSError` where the directory cannot be used, `ValueError` where others can.
    """

    def __init__(self, run_dir: Path) -> None:
        make_run_dir(run_dir)
        self._path = run_dir / f"snapshot-{os.getpid()}.json"
        self._file = open(self._path, "wb", buffering=0, opener=no_link)  # noqa: SIM115
        fcntl.flock(self._file, fcntl.LOCK_EX)
        self._state = State(pid=os.getpid())
        self._write(self._state)

    def say_busy(self) -> None:
        """A snapshot is being written."""
        self._write(msgspec.structs.replace(self._state, busy=True))

    def answer(self, snapshot: Snapshot) -> None:
        """Write the result of the trigger."""
        self._write(State(pid=self._state.pid, answers=self._state.answers + 1, last=snapshot))

    def close(self) -> None:
        """Take the file away."""
        self._path.unlink(missing_ok=True)
        self._file.close()

    def _write(self, state: State) -> None:
        self._state = state
        # in place, because a new file would not be locked; readers try again where they see half of it
        os.pwrite(self._file.fileno(), data := msgspec.json.encode(state) + b"\n", 0)
        os.ftruncate(self._file.fileno(), len(data))


def find_recorders(run_dir: Path) -> list[Path]:
    """Files of the living recorders that hold snapshots."""
    return [path for path in sorted(run_dir.glob("snapshot-*.json")) if _is_locked(path)]


def ask(path: Path, timeout_s: float) -> Snapshot:
    """Have a recorder write what it holds; raises `TimeoutError` where no answer comes, `OSError` where it ended."""
    deadline_s = time.monotonic() + timeout_s
    # what is being written was asked for by somebody else, earlier
    state = _wait(path, deadline_s, lambda state: not state.busy)
    os.kill(state.pid, signal.SIGUSR1)
    return _wait(path, deadline_s, lambda later: later.answers > state.answers).last


def _wait(path: Path, deadline_s: float, until: Callable[[State], bool]) -> State:
    while time.monotonic() < deadline_s:
        if not _is_locked(path):
            raise ChildProcessError(f"{path}: its recorder has ended")
        try:
            with open(path, "rb", opener=no_link) as file:
                state = msgspec.json.decode(file.read(), type=State)
        except (msgspec.MsgspecError, FileNotFoundError):
            # half written, or just taken away: the next look tells
            state = None
        if state is not None and until(state):
            return state
        time.sleep(_POLL_S)
    raise TimeoutError(f"{path}: its recorder did not answer in time")


def _is_locked(path: Path) -> bool:
    try:
        with open(path, "rb", opener=no_link) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (FileNotFoundError, ValueError):
        # just taken away, or a symbolic link
        pass
    return False
