"""What the player, the former and the recorder do with each beam of 4 MiB, against the memory bandwidth of the machine.

In one run and on one thread: reading, writing and copying arrays far larger than the caches; then each step of the
three nodes on 25 different beams in turn (100 MiB: none of it is in a cache when its turn comes). Bytes are those that
a step must read and write; its share of the bandwidth is their rate over the rate at which the machine copies. All
steps are visited in turn, `--rounds` times; times are medians. The scene and its seed are those of the launch file (0).
Usage: OPENBLAS_NUM_THREADS=1 python -m benchmarks.live.bandwidth [--rounds 5] [--folder DIR] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from mirrorwave.studies.report import table
from mirrorwave.studies.tradeoff.runner import socket_hop
from models.compiled import compiled
from models.perception.forming.ra_forming import BeamFolder, FormingParams
from models.perception.forming.slow_time_sums import fold_chirps
from msgs.bus.codec import encode_inline
from msgs.bus.interface import Envelope, Received
from msgs.recording.mcap_writer import reserve
from msgs.values.radar import RadarBeam, RangeAzimuthGrid
from nodes import player, recorder
from sim_player.player import ScenePlayer

SCENE = "launch/scenes/facade_across_lane.yaml"
MIB = 1 << 20
_LARGE = 256 * MIB
_RESERVE_BYTES = 16 * MIB


class Step(NamedTuple):
    """Something done to a beam, or to the machine's memory."""

    name: str
    #: Bytes that it must read and write.
    moved: int
    #: Do it to beam number ... of the 25.
    act: Callable[[int], object]


@compiled
def _sum(values: np.ndarray) -> int:
    total = 0
    for value in values:
        total += value
    return total


def memory_steps() -> list[Step]:
    """Reading, writing and copying a large array once."""
    source, sink = np.ones(_LARGE, np.uint8), np.ones(_LARGE, np.uint8)
    words = source.view(np.int64)
    _sum(words[:8])
    return [
        Step("memory: read", _LARGE, lambda _: _sum(words)),
        Step("memory: write", _LARGE, lambda _: sink.fill(1)),
        Step("memory: copy", 2 * _LARGE, lambda _: np.copyto(sink, source)),
    ]


def played() -> ScenePlayer:
    """The radar of the launch file."""
    radar = player.scene_player(msgspec.convert({"scene": SCENE, "effects": "auto"}, player.Params))
    if not isinstance(radar, ScenePlayer):
        raise ValueError(f"scene must be a radar's, got {SCENE!r}")
    return radar


def player_steps(size: int) -> tuple[list[Step], list[RadarBeam]]:
    """Making a beam: its noise and echoes as float32 pairs are read, its codes written."""
    radar = played()
    beams = [radar.beam(0, index) for index in range(len(radar.setup.beams))]
    # float32 noise has twice the bytes of int16 codes
    return [Step("player: a beam", 3 * size, lambda index: radar.beam(1, index))], beams


def former_steps(beams: list[RadarBeam], size: int) -> list[Step]:
    """Folding a beam; the rest works on its sums, which are an eighth of it."""
    folder = BeamFolder(played().setup, FormingParams(), RangeAzimuthGrid())
    sums = fold_chirps(beams[0].samples, folder.groups)[0].nbytes
    return [
        Step("former: sums over chirps", size + sums, lambda index: fold_chirps(beams[index].samples, folder.groups)),
        Step("former: a beam", size + sums, lambda index: folder.fold(beams[index])),
    ]


def recorder_steps(beams: list[RadarBeam], size: int, folder: Path, numbers: Iterator[int]) -> list[Step]:
    """Encoding, checksum and writing apart, and the node's whole step."""
    node = recorder.create(
        recorder.Params(path=str(folder / "bandwidth.mcap"), topics=("radar/beam",), min_free_bytes=0)
    )
    encoded = [encode_inline(beam) for beam in beams]
    plain = (folder / "plain").open("xb", buffering=0)
    reserved = 0

    def write(index: int) -> None:
        nonlocal reserved
        at = plain.tell()
        if at + size > reserved:
            reserved = at + size + _RESERVE_BYTES
            reserve(plain.fileno(), at, reserved - at)
        plain.write(encoded[index])

    def step(index: int) -> None:
        number = next(numbers)
        beam = msgspec.structs.replace(beams[index], stamp_ns=number)
        envelope = Envelope(publisher="player", topic="radar/beam", sequence=number, sent_ns=number)
        node.step([Received("radar/beam", beam, envelope)], time.monotonic_ns())

    return [
        Step("recorder: encode", 2 * size, lambda index: encode_inline(beams[index])),
        Step("recorder: one CRC32", size, lambda index: zlib.crc32(encoded[index])),
        Step("recorder: write()", 2 * size, write),
        # encoded, read for one checksum, written
        Step("recorder: a beam", 5 * size, step),
    ]


def measure(steps: list[Step], beams: int, rounds: int) -> dict[str, dict[str, float]]:
    """Median milliseconds of each step, its rate, and that rate over the rate of a copy."""
    times_ms: dict[str, list[float]] = {step.name: [] for step in steps}
    for _ in range(rounds):
        for step in steps:
            is_memory = step.name.startswith("memory")
            for index in range(3 if is_memory else beams):
                start_ns = time.perf_counter_ns()
                step.act(index)
                times_ms[step.name].append(1e-6 * (time.perf_counter_ns() - start_ns))
    median_ms = {name: float(np.median(values)) for name, values in times_ms.items()}
    rates = {step.name: 1e-6 * step.moved / median_ms[step.name] for step in steps}
    return {
        step.name: {
            "mib": round(step.moved / MIB, 1),
            "ms": round(median_ms[step.name], 3),
            "p90_ms": round(float(np.quantile(times_ms[step.name], 0.9)), 3),
            "gb_per_s": round(rates[step.name], 2),
            "of_copy": round(rates[step.name] / rates["memory: copy"], 2),
        }
        for step in steps
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--folder", type=Path, help="where to record; needs 0.2 GB a round")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    size = 4 * MIB
    making, beams = player_steps(size)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name, socket_hop() as hop:
        # from memory to the socket's and from there to memory
        through = Step("bus: send and receive", 4 * size, lambda index: hop("radar/beam", beams[index]))
        steps = memory_steps() + making + [through] + former_steps(beams, size)
        steps += recorder_steps(beams, size, Path(name), iter(range(1, 1_000_000)))
        rows = measure(steps, len(beams), arguments.rounds)
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}"
    if arguments.json:
        print(json.dumps({"machine": machine, "rows": rows}))
        return
    print(machine)
    heads = ("step", "MiB", "ms", "p90", "GB/s", "of a copy's rate")
    print("\n".join(table(heads, [(name, *row.values()) for name, row in rows.items()])))


if __name__ == "__main__":
    main()
