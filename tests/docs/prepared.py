"""Files that pages of the documentation take for given, made once and small."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import can

from lab.tradeoff import latency_budget
from mirrorwave.cli import main
from msgs.recording.mcap import RecordingReader
from msgs.values.vehicle import VehicleState
from nodes.can.bus import load_dbc, load_mapping
from sim_player.car import SimulatedCar
from tests.contrib.boards.test_import_dca1000 import CFG, point, two_lanes
from tests.mirrorwave.commands.captures.test_can import write_drive

SMALL = ["-p", "player.chirps_per_beam=8"]
#: The same of `sim run`, with the paths alone that every scene has.
BEAMS = ["--chirps-per-beam", "8", "--effects", "basic"]
#: How long a graph may run until it has said everything.
DURATIONS_S = (1, 4, 16, 64, 128)
#: Channel of python-can's virtual bus on which a car speaks while pages are run.
CAN_CHANNEL = "docs"


def remember_trials(expected_ms: float) -> None:
    """Have every profile tried on this machine, as the cache of `launch --latency-budget-ms` remembers it."""
    known = latency_budget._known()
    memory = latency_budget._Memory(latency_budget.cache_path(), latency_budget._key(known), forget=True)
    for row in known:
        memory.keep(latency_budget.Timed(profile=row.profile, loss=row.loss, expected_ms=expected_ms), is_lasting=True)


def _corner(folder: Path) -> None:
    scene, out = "launch/scenes/corner.yaml", str(folder / "corner.mcap")
    assert main(["sim", "run", scene, "--out", out, "--scans", "2", *BEAMS]) == 0


def _truth(folder: Path) -> None:
    """Two places, each with simulated LiDAR clouds and a scan, labelled."""
    for place in ("two_hidden_vehicles", "facade_across_lane"):
        scene, scan = f"launch/scenes/{place}.yaml", folder / f"{place}.mcap"
        clouds = folder / "clouds" / place
        assert main(["sim", "lidar", scene, "--out", str(clouds)]) == 0
        assert main(["sim", "run", scene, "--out", str(scan), *BEAMS]) == 0
        labels = ["--out", str(folder / "truth"), "--kind", "sim"]
        assert main(["annotate", str(clouds / "scene.yaml"), "--radar", str(scan), *labels]) == 0


def _seen(folder: Path) -> None:
    """Everything that a graph says, raw beams included; on a machine with much else to do it takes longer to say it."""
    seen = folder / "seen.mcap"
    for duration_s in DURATIONS_S:
        seen.unlink(missing_ok=True)
        recorded = ["--record", str(seen), "--raw", "--runs-dir", str(folder / "seen_run")]
        assert main(["launch", "launch/corner.yaml", *SMALL, "--duration", str(duration_s), *recorded]) == 0
        with RecordingReader(seen) as reader:
            if any(reader.messages(["perception/hidden_objects"])):
                return
    raise TimeoutError(f"no view in {DURATIONS_S[-1]} s")


def _drive(folder: Path) -> None:
    write_drive(folder / "drive.log")
    for suffix in ("dbc", "yaml"):
        shutil.copy(f"launch/can/mirrorwave.{suffix}", folder / f"car.{suffix}")


def _dca1000(folder: Path) -> None:
    (folder / "capture.bin").write_bytes(2 * two_lanes(point()))
    (folder / "chirps.cfg").write_text(CFG)


def _detections(folder: Path) -> None:
    rows = [f"{0.06 * at:.2f},{10 + at},{5 * at - 10},-1.5,3" for at in range(5)]
    (folder / "detections.csv").write_text("\n".join(["stamp_s,range_m,azimuth_deg,radial_speed_mps,rcs_dbsm", *rows]))


#: What a page needs beside the checkout: file or folder -> how it is made. Those of one maker come together.
MAKERS: dict[str, Callable[[Path], None]] = {
    "corner.mcap": _corner,
    "seen.mcap": _seen,
    "truth": _truth,
    "drive.log": _drive,
    "car.dbc": _drive,
    "car.yaml": _drive,
    "capture.bin": _dca1000,
    "chirps.cfg": _dca1000,
    "detections.csv": _detections,
}


class Prepared:
    """Makes files at first use and lends copies of them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._made: set[Callable[[Path], None]] = set()

    def lend(self, name: str, folder: Path) -> None:
        """Put a file into a page's folder."""
        if MAKERS[name] not in self._made:
            MAKERS[name](self._folder)
            self._made.add(MAKERS[name])
        source = self._folder / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, folder / name)


@contextmanager
def speaking_car() -> Iterator[None]:
    """A car that says on a virtual CAN bus of this process how it moves, ten times a second."""
    ended = threading.Event()

    def speak() -> None:
        car = SimulatedCar(
            load_dbc(Path("launch/can/mirrorwave.dbc")), load_mapping(Path("launch/can/mirrorwave.yaml"))
        )
        with can.Bus(interface="virtual", channel=CAN_CHANNEL, ignore_config=True) as bus:
            now_ns = 0
            while not ended.wait(0.02):
                now_ns += 20_000_000
                for frame in car.frames(VehicleState(stamp_ns=now_ns, speed_mps=9.0, yaw_rate_rps=0.1)):
                    bus.send(can.Message(arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False))

    thread = threading.Thread(target=speak, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
