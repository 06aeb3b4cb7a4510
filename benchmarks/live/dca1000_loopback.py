"""A DCA1000 card on the loopback: rate held, losses injected and counted, samples equal to those that were sent.

Another process is the card: it answers commands and sends random codes as datagrams at a steady rate, some lost and
some out of order as a seed draws them. This process is the node, driven as its own loop drives it, without the rest
of the graph. What the kernel drops beyond the injected losses counts as dropped.
Usage: python -m benchmarks.live.dca1000_loopback [--rates 0.3,5,20,40] [--duration S] [--loss SHARE] [--seed N]
       [--json]
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import socket
import struct
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from models.sensors.config_file import read_config
from models.sensors.dca1000_packets import PAYLOAD_BYTES, SampleFrame, datagram
from msgs.values.radar import RadarBeam
from nodes import dca1000_radar
from nodes.drivers import dca1000

HOST, CARD = "127.0.0.1", "127.0.0.2"
#: Frames of 1 MiB: two transmitters, 128 loops of 256 samples.
CONFIG = """% Platform:xWR18xx
channelCfg 15 5 0
adcCfg 2 1
profileCfg 0 77 7 6 57 0 0 60 1 256 5209 0 0 30
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 4
frameCfg 0 1 128 0 {period_ms} 1 0
"""
FRAME_BYTES = 1 << 20
#: The recording repeats after so many frames.
FRAMES = 4
#: Datagrams that leave together; their order is shuffled where any is.
GROUP = 16
#: Share of groups whose order is.
SHUFFLED = 0.1
SETTLE_S = 1.0


def recording(seed: int) -> bytes:
    """Random codes, none zero: what is zero on the other side was missing."""
    codes = np.random.default_rng(seed).integers(1, 1 << 15, FRAMES * FRAME_BYTES // 2)
    return codes.astype("<i2").tobytes()


def run_card(ports: tuple[int, int], count: int, rate_mb_per_s: float, loss: float, seed: int, done: Any) -> None:
    """Answer commands; send a recording of `count` datagrams once it is started, and report what was left out."""
    rng = np.random.default_rng(seed)
    lost = rng.random(count) < loss
    lost[[0, -1]] = False
    content = recording(seed)
    content += content[:PAYLOAD_BYTES]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as card:
        card.bind((CARD, ports[0]))
        done.put("ready")
        answer_until(card, dca1000.START_RECORD)
        time.sleep(SETTLE_S)
        start_s, late_s = time.monotonic(), 0.0
        for first in range(0, count, GROUP):
            wait_s = start_s + first * PAYLOAD_BYTES / (1e6 * rate_mb_per_s) - time.monotonic()
            late_s = max(late_s, -wait_s)
            if wait_s > 0.0:
                time.sleep(wait_s)
            group = np.arange(first, min(first + GROUP, count))
            # the first and the last datagram keep their places
            if rng.random() < SHUFFLED and 0 < first < count - GROUP:
                rng.shuffle(group)
            for at in group[~lost[group]].tolist():
                place = at * PAYLOAD_BYTES
                begin = place % (FRAMES * FRAME_BYTES)
                card.sendto(datagram(1 + at, place, content[begin : begin + PAYLOAD_BYTES]), (HOST, ports[1]))
        done.put({"lost": int(lost.sum()), "seconds": time.monotonic() - start_s, "late_s": late_s})
        answer_until(card, dca1000.STOP_RECORD)


def answer_until(card: socket.socket, last: int) -> None:
    """Answer commands, the last of which has this code."""
    code = None
    while code != last:
        asked, sender = card.recvfrom(2048)
        _, code, _ = struct.unpack_from("<HHH", asked)
        card.sendto(struct.pack("<HHHH", dca1000.HEADER, code, 0, dca1000.FOOTER), sender)


def differing_bytes(frame: SampleFrame, expected: np.ndarray) -> int:
    """Bytes of a frame, apart from those that it says are missing, that are not the card's."""
    same = frame.codes.view(np.uint8) == expected[frame.number % FRAMES]
    for start, end in frame.gaps:
        same[start:end] = True
    return int(np.count_nonzero(~same))


def measure(rate_mb_per_s: float, duration_s: float, loss: float, seed: int, folder: Path) -> dict[str, Any]:
    """Figures of a run at a rate."""
    count = max(int(1e6 * rate_mb_per_s * duration_s / PAYLOAD_BYTES), 2)
    ports = free_ports()
    path = folder / "chirps.cfg"
    path.write_text(CONFIG.format(period_ms=max(1e3 * FRAME_BYTES / (1e6 * rate_mb_per_s), 17.0)))
    assert read_config(path, None).frame_bytes == FRAME_BYTES
    context = multiprocessing.get_context("spawn")
    done = context.Queue()
    card = context.Process(target=run_card, args=(ports, count, rate_mb_per_s, loss, seed, done), daemon=True)
    card.start()
    address = dca1000.Params(host_address=HOST, card_address=CARD, command_port=ports[0], data_port=ports[1])
    node = dca1000_radar.Dca1000Radar(dca1000_radar.Params(config=str(path), card=address))
    assert done.get(timeout=60.0) == "ready"
    node.open()
    expected = np.frombuffer(recording(seed), np.uint8).reshape(FRAMES, FRAME_BYTES)
    # frames are compared as the node takes them: a test of its own would have to copy them
    differing, seen = 0, 0
    made = node._beams

    def compared(frame: SampleFrame) -> Any:
        nonlocal differing, seen
        if rate_mb_per_s <= 5.0 or frame.number % 16 == 0:
            differing, seen = differing + differing_bytes(frame, expected), seen + 1
        return made(frame)

    node._beams = compared  # type: ignore[method-assign]
    process = psutil.Process()
    cpu_s, beams, sent = sum(process.cpu_times()[:2]), 0, None
    end_s = None
    while end_s is None or time.monotonic() < end_s:
        now_ns = time.monotonic_ns()
        beams += sum(isinstance(out.message, RadarBeam) for out in node.step([], now_ns))
        if sent is None and not done.empty():
            sent = done.get()
            end_s = time.monotonic() + SETTLE_S
        if not node.pending():
            time.sleep(max(1e-9 * ((node.due_ns(now_ns) or 0) - time.monotonic_ns()), 0.0))
    assert sent is not None
    cpu_s = sum(process.cpu_times()[:2]) - cpu_s
    counts, link = node._assembler.counts, node._card.counts
    node.close()
    card.join()
    shed = {f"{each.what}, {each.reason}": each.count for each in node.shed.counts()}
    return {
        "rate_mb_per_s": count * PAYLOAD_BYTES / sent["seconds"] / 1e6,
        "datagrams_per_s": count / sent["seconds"],
        "sent": count - sent["lost"],
        "injected_losses": sent["lost"],
        "counted_losses": counts.lost,
        "dropped": counts.lost - sent["lost"],
        "queue_full": link.overrun,
        "late": counts.late,
        "frames_compared": seen,
        "differing_bytes": differing,
        "beams": beams,
        "cores": cpu_s / sent["seconds"],
        "sender_late_s": sent["late_s"],
        "shed": shed,
    }


def free_ports() -> tuple[int, int]:
    """Two ports that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as a, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as b:
        for each in (a, b):
            each.bind((HOST, 0))
        return int(a.getsockname()[1]), int(b.getsockname()[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", default="0.3,5,20,40", help="MB/s of samples, by commas")
    parser.add_argument("--duration", type=float, default=10.0, help="seconds at each rate")
    parser.add_argument("--loss", type=float, default=0.01, help="share of datagrams left out")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        results = [
            measure(float(rate), arguments.duration, arguments.loss, arguments.seed, Path(folder))
            for rate in arguments.rates.split(",")
        ]
    if arguments.json:
        print(json.dumps(results))
        return
    for result in results:
        print(json.dumps(result))


if __name__ == "__main__":
    main()
