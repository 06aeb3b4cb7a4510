"""A process with the nodes' libraries loaded, which forks to become a node whenever its supervisor asks.

Imports and the set-up of the compiler are most of a node's start, and their memory is the same in each: here both are
paid for once. A forked node is the supervisor's own child, as one that was started by itself.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import importlib
import json
import os
import signal
import socket
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from msgs.files.shipped import CHECKOUT
from nodes.process.interpreter import module_command
from nodes.process.memory import release_unused

#: A node is one of several processes on few cores: BLAS threads that spin while they wait took a whole core from the
#: others (RA former 1.1 against 0.2 cores), and malloc returned each 4 MiB beam to the system only to ask again.
NODE_ENVIRONMENT = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(64 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(256 << 20),
    # `malloc_trim` gives back the end of the first heap alone, and what a socket's thread receives would lie in its own
    "MALLOC_ARENA_MAX": "1",
}
#: What several nodes import, or their kernels need. Not onnxruntime: it starts threads, which a fork does not copy.
LIBRARIES = ("msgs.bus.zmq", "nodes.node", "numba", "scipy.fft", "scipy.ndimage")
#: Longest command line that a forked node shows.
ROOM = 4096
#: Largest request.
MAX_BYTES = 1 << 17
READY = b"ready"
#: A server that is not ready by then is left; one that forks answers within milliseconds.
START_TIMEOUT_S, ANSWER_TIMEOUT_S = 60.0, 5.0
_PR_SET_CHILD_SUBREAPER = 36
#: Fields of proc_pid_stat(5), counted from the third.
_ARG_START, _ARG_END = 45, 46


def adopt_orphans(wanted: bool) -> None:
    """Have the kernel make this process the parent of its children's orphans, or not any more; Linux only."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_CHILD_SUBREAPER, int(wanted), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "the kernel refused PR_SET_CHILD_SUBREAPER")


def spawn(words: list[str], env: Mapping[str, str], given: int, output: int | None = None) -> int:
    """Start an interpreter that runs a module as a program, in a process group of its own; return its pid.

    `given` is its standard input, `output` takes what it says, or None: what this process says too.
    """
    copies = [(given, 0)] if output is None else [(given, 0), (output, 1), (output, 2)]
    return os.posix_spawn(
        sys.executable,
        module_command(words),
        env,
        file_actions=[(os.POSIX_SPAWN_DUP2, *ends) for ends in copies],
        setpgroup=0,
        # what Python itself ignores
        setsigdef=[signal.SIGPIPE, signal.SIGXFSZ],
    )


def environment(own: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of a process of the graph, with variables of its own."""
    # the nodes are those of this checkout, wherever the graph was started
    paths = [str(CHECKOUT), *filter(None, [os.environ.get("PYTHONPATH")])]
    common = {"PYTHONUNBUFFERED": "1", "PYTHONPATH": os.pathsep.join(paths)}
    return {**os.environ, **NODE_ENVIRONMENT, **common, **own}


class ForkServer:
    """The supervisor's end: starts the server, and asks it for nodes once it is ready.

    It makes this process the parent of all orphans among its descendants until it is closed. A server that fails is
    left: nodes are then started by themselves.
    """

    def __init__(self) -> None:
        self._channel, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        words = ["nodes.process.fork_server", "--die-with", str(os.getpid())]
        adopt_orphans(True)
        with other:
            self._pid: int | None = spawn([*words, "--room", "." * ROOM], environment({}), other.fileno())
        self._give_up_s = time.monotonic() + START_TIMEOUT_S
        self.is_starting = True
        #: Why there is no server any more; empty while there is.
        self.failure = ""
        self._channel.setblocking(False)

    def fileno(self) -> int:
        """Return a descriptor that can be read once the server is ready or has failed."""
        return self._channel.fileno()

    def look(self) -> None:
        """Notice that it is ready, or has failed; never waits."""
        if not self.is_starting:
            return
        try:
            is_ready = self._channel.recv(MAX_BYTES) == READY
        except BlockingIOError:
            if time.monotonic() > self._give_up_s:
                self._fail(f"it was not ready after {START_TIMEOUT_S:g} s")
            return
        except OSError as error:
            self._fail(str(error))
            return
        if is_ready:
            self.is_starting = False
            self._channel.settimeout(ANSWER_TIMEOUT_S)
        else:
            self._fail("it has ended")

    def fork(self, words: list[str], given: int, output: int) -> int | None:
        """Return the pid of a new node; None where the server cannot fork it.

        `words`: the module whose `main` it runs, and its arguments; `given` and `output` are its standard input and
        output. Raises `OSError` where the machine has no memory or process left.
        """
        if self.is_starting or self.failure:
            return None
        try:
            socket.send_fds(self._channel, [json.dumps(words).encode()], [given, output])
            answer = json.loads(self._channel.recv(MAX_BYTES))
        except (OSError, ValueError) as error:
            self._fail(str(error))
            return None
        if "error" in answer:
            raise OSError(answer["error"])
        return int(answer["pid"])

    def close(self) -> None:
        """End the server."""
        self._end()
        self._channel.close()
        adopt_orphans(False)

    def _fail(self, reason: str) -> None:
        self.is_starting, self.failure = False, reason
        self._end()

    def _end(self) -> None:
        if self._pid is not None:
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)
            self._pid = None


def load_libraries() -> None:
    """Import what nodes need, and what the first compiled kernel would set up."""
    for name in LIBRARIES:
        importlib.import_module(name)
    from models.compiled import prepare

    prepare()


def threads() -> int:
    """Return the number of threads of this process, those of libraries included."""
    return len(os.listdir("/proc/self/task"))


def serve(channel: socket.socket) -> list[str] | None:
    """Answer requests until the parent closes its end: None. In a forked node: the words of its command."""
    channel.send(READY)
    while True:
        data, descriptors, _, _ = socket.recv_fds(channel, MAX_BYTES, 2)
        if not data:
            return None
        try:
            pid = _fork()
        except OSError as error:
            channel.send(json.dumps({"error": str(error)}).encode())
        else:
            if pid is None:
                words = json.loads(data)
                _become_node(channel, descriptors, words)
                return list(words)
            channel.send(json.dumps({"pid": pid}).encode())
        for descriptor in descriptors:
            os.close(descriptor)


def _fork() -> int | None:
    """Fork a process that its grandparent adopts; return its number, and None in itself."""
    read_end, write_end = os.pipe()
    between = os.fork()
    if between:
        os.close(write_end)
        with open(read_end, "rb") as answer:
            said = answer.read()
        os.waitpid(between, 0)
        if not said.isdigit():
            raise OSError(said.decode() or "the process in between has ended")
        return int(said)
    between = os.getpid()
    try:
        pid = os.fork()
        if pid:
            # here, so that its group can be signalled as soon as its number is known
            os.setpgid(pid, pid)
            os.write(write_end, b"%d" % pid)
            os._exit(0)
    except OSError as error:
        os.write(write_end, str(error).encode())
        os._exit(1)
    os.close(read_end)
    os.close(write_end)
    while os.getppid() == between:
        time.sleep(1e-4)
    return None


def _become_node(channel: socket.socket, descriptors: list[int], words: list[str]) -> None:
    """Take over standard input and output of a node, and its command line."""
    channel.close()
    given, output = descriptors
    for source, target in ((given, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    for descriptor in descriptors:
        os.close(descriptor)
    sys.argv = words[1:]
    with contextlib.suppress(OSError, ValueError, IndexError):
        _show_command(module_command(words))


def _show_command(words: list[str]) -> None:
    """Write a command line over this process's own, as far as it has room, for `ps` and `mirrorwave node info`."""
    fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
    start, room = int(fields[_ARG_START]), int(fields[_ARG_END]) - int(fields[_ARG_START])
    line = b"".join(os.fsencode(word) + b"\0" for word in words)
    ctypes.memset(start, 0, room)
    ctypes.memmove(start, line, min(len(line), room - 1))


def main(argv: list[str] | None = None) -> int:
    """Serve, or be a node; return the exit code."""
    from nodes.node import die_with_parent

    parser = argparse.ArgumentParser(
        prog="python -m nodes.process.fork_server", description="Fork nodes for a supervisor."
    )
    parser.add_argument("--die-with", required=True, type=int, metavar="PID", help="end with this parent process")
    parser.add_argument("--room", help="room for the command line of a node")
    arguments = parser.parse_args(argv)
    try:
        die_with_parent(arguments.die_with)
    except ProcessLookupError:
        # the command has ended before there was a graph
        return 0
    load_libraries()
    if threads() > 1:
        sys.stderr.write(
            f"libraries of the fork server must start no threads, got {threads()}: a fork copies only one\n"
        )
        return 1
    release_unused()
    # collecting them in a forked node would copy the pages of all that is shared
    gc.freeze()
    words = None
    # a parent that ends takes its end of the channel with it, whatever is on its way
    with socket.socket(fileno=os.dup(0)) as channel, contextlib.suppress(ConnectionError):
        words = serve(channel)
    return 0 if words is None else run_node(words)


def run_node(words: list[str]) -> int:
    """Run the `main` of the module that `words` begin with, on the rest of them."""
    return int(importlib.import_module(words[0]).main(words[1:]))


if __name__ == "__main__":
    sys.exit(main())
