"""The node in C builds without a warning and speaks the wire: it reads what the bus publishes, and the bus reads it."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from msgs.bus.zmq import ZmqBus
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeState, NodeStatus
from msgs.values.perception import BevFrame, BevGrid
from msgs.values.vehicle import VehicleState
from tests.builders import example_object
from tests.docs.pages import C_LIBRARIES, has_c_libraries

SOURCE = CHECKOUT / "examples" / "my_node" / "my_node.c"
#: A test that waits longer has failed.
PATIENCE_S = 60.0

pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(
        shutil.which("cc") is None or not has_c_libraries(),
        reason=f"needs cc, pkg-config and the headers of {', '.join(C_LIBRARIES)}",
    ),
]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    built = tmp_path_factory.mktemp("c") / "my_node"
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", *C_LIBRARIES], capture_output=True, text=True, check=True
    )
    compiler = ["cc", "-O2", "-Wall", "-Wextra", "-Werror", "-o", str(built), str(SOURCE)]
    subprocess.run([*compiler, *flags.stdout.split()], check=True)
    return built


@pytest.fixture
def run_dir() -> Iterator[Path]:
    # a short path: socket names are limited
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        yield Path(folder) / "g"


def view(scan_id: int, *positions_m: tuple[float, float]) -> BevFrame:
    grid = BevGrid()
    objects = tuple(example_object(id=number, x_m=x_m, y_m=y_m) for number, (x_m, y_m) in enumerate(positions_m))
    return BevFrame(
        stamp_ns=scan_id,
        scan_id=scan_id,
        objects=objects,
        los_points_m=np.zeros((3, 2), np.float32),
        visibility=np.zeros((grid.rows, grid.columns), np.uint8),
        ego=VehicleState(stamp_ns=scan_id, speed_mps=3),
    )


def until(bus: ZmqBus, done: Callable[[], object]) -> None:
    """Wait until something has come; the bus's messages are left to the condition."""
    end_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end_s


def test_it_is_heard_and_hears(program: Path, run_dir: Path) -> None:
    """Its state and heartbeats are accepted message by message, without a loss; it prints the objects of each scan that
    a publisher sends which came after it.
    """
    bus = ZmqBus("geometry", run_dir)
    process = None
    try:
        bus.subscribe("vehicle/state")
        bus.subscribe("diagnostics/node")
        process = subprocess.Popen([program, str(run_dir), "7.5"], stdout=subprocess.PIPE, text=True)
        heard: list[object] = []

        def states() -> bool:
            heard.extend(received.message for received in bus.receive(0.1))
            return len([message for message in heard if isinstance(message, VehicleState)]) >= 30

        until(bus, states)
        assert {message.speed_mps for message in heard if isinstance(message, VehicleState)} == {7.5}
        beats = [message for message in heard if isinstance(message, NodeStatus)]
        assert {(beat.node, beat.pid, beat.state) for beat in beats} == {("my_node", process.pid, NodeState.READY)}
        assert [(count.lost, count.rejected) for count in bus.counts()[0]] == [(0, 0), (0, 0)]
        assert printed_lines(bus, process) == [
            "scan 0, vehicle at 3.0 m/s: 1.5, -2.5 m; 10.0, 4.0 m;",
            "scan 1, vehicle at 3.0 m/s: nothing hidden",
        ]
    finally:
        if process is not None:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()
        bus.close()


def printed_lines(bus: ZmqBus, process: subprocess.Popen[str]) -> list[str]:
    """Publish a scan until it is printed, then the next; the lines of both."""
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), False)
    lines: list[str] = []
    for scan_id, positions_m in enumerate([((1.5, -2.5), (10.0, 4.0)), ()]):
        start = f"scan {scan_id},"

        def is_printed(scan_id: int = scan_id, positions_m: tuple = positions_m, start: str = start) -> bool:
            bus.publish("perception/hidden_objects", view(scan_id, *positions_m))
            bus.receive(0.1)
            assert process.stdout is not None
            lines.extend(process.stdout.readlines())
            return any(line.startswith(start) for line in lines)

        until(bus, is_printed)
    assert not [line for line in lines if "lost" in line]
    return sorted({line.strip() for line in lines})


def test_it_ends_when_its_time_is_over_and_starts_again(program: Path, run_dir: Path) -> None:
    """Its socket files of before are in no way of the next one."""
    run_dir.mkdir(mode=0o700)
    command = [program, str(run_dir), "0", "0.3"]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


@pytest.mark.parametrize("words", [[], ["a", "1", "2", "3"]])
def test_wrong_usage_is_one_line(program: Path, words: list[str]) -> None:
    done = subprocess.run([program, *words], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (2, "usage: my_node RUN_DIR [SPEED_MPS [SECONDS]]\n")


def test_a_folder_that_is_not_there_is_one_line(program: Path, tmp_path: Path) -> None:
    command = [program, str(tmp_path / "none")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith(f"my_node: {tmp_path}/none: ")
    assert done.stderr.count("\n") == 1
