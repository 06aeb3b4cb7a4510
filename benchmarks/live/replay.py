"""A full-size drive played into the living graph at several rates: pace achieved, scans lost, the same bytes or not.

Each rate plays into a graph of its own (launch/replay.yaml); what it says is held against `mirrorwave process` and
against the other rates, line by line. Rows `realtime` keep time, as a radar would, and lose what does not fit.
Usage: python -m benchmarks.live.replay [--scans N] [--scene FILE] [--rates 1,10,0] [--realtime 1] [--profile NAME]
[--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mirrorwave.console import print_json, print_line, print_table
from mirrorwave.convert.result_lines import bev_to_json
from msgs.bus.zmq import list_publishers, run_dir
from msgs.files.shipped import CHECKOUT
from msgs.recording.mcap import RecordingReader
from msgs.values.perception import BevFrame

ROOT = CHECKOUT
ANSWER = "perception/hidden_objects"
NODES = {"ra_former", "dense_predictor", "geometry", "recorder"}


def mirrorwave(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "mirrorwave", *arguments]


def run(scene: Path, scans: int, profile: str, rates: list[tuple[float, bool]]) -> dict:
    with tempfile.TemporaryDirectory(prefix="mw") as folder:
        work = Path(folder)
        drive = work / "drive.mcap"
        make = mirrorwave("sim", "run", str(scene), "--out", str(drive), "--scans", str(scans))
        subprocess.run(make, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        started_s = time.monotonic()
        process = mirrorwave("process", str(drive), "--out", str(work / "out"), "--profile", profile)
        subprocess.run(process, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        process_s = time.monotonic() - started_s
        expected = (work / "out" / "objects.jsonl").read_text().splitlines()
        rows = [replay(work, drive, profile, rate, realtime, expected) for rate, realtime in rates]
        megabytes = drive.stat().st_size / 1e6
    return {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, {platform.platform()}",
        "scene": scene.name,
        "scans": scans,
        "megabytes": round(megabytes, 1),
        "process_s": round(process_s, 2),
        "replays": rows,
    }


def replay(work: Path, drive: Path, profile: str, rate: float, realtime: bool, expected: list[str]) -> dict:
    domain, seen = f"bench{os.getpid()}", work / f"seen_{rate:g}_{realtime}.mcap"
    launch = ["launch", "launch/replay.yaml", "--headless", "--record", str(seen), "--profile", profile]
    graph = subprocess.Popen(
        mirrorwave(*launch, "--domain", domain, "--runs-dir", str(work / "runs")), cwd=ROOT, stdout=subprocess.DEVNULL
    )
    try:
        await_nodes(graph, domain)
        play = mirrorwave("bag", "play", str(drive), "--rate", f"{rate:g}", "--domain", domain, "--json")
        played = subprocess.run(play + ["--realtime"] * realtime, cwd=ROOT, stdout=subprocess.PIPE, check=False)
    finally:
        graph.send_signal(signal.SIGINT)
        graph.wait(timeout=60.0)
    if not played.stdout:
        raise RuntimeError(f"bag play ended with exit code {played.returncode}")
    told = json.loads(played.stdout)
    with RecordingReader(seen) as reader:
        frames = [one.message for one in reader.messages([ANSWER])]
    lines = [json.dumps(bev_to_json(frame)) for frame in frames if isinstance(frame, BevFrame)]
    return {
        "rate": rate,
        "realtime": realtime,
        "achieved_rate": told["achieved_rate"],
        "elapsed_s": told["elapsed_s"],
        "scans_lost": len(expected) - len(lines),
        "unanswered": told["unanswered"],
        "told": told["lost"],
        "identical_to_process": lines == expected,
        "exit_code": played.returncode,
    }


def await_nodes(graph: subprocess.Popen, domain: str) -> None:
    """Wait until all nodes are there; `bag play` waits until they are ready."""
    while not {node for _, node in list_publishers(run_dir(domain))} >= NODES:
        if graph.poll() is not None:
            raise RuntimeError(f"the graph ended with exit code {graph.returncode}")
        time.sleep(0.1)


def print_result(result: dict) -> None:
    print_line(f"{result['scene']}: {result['scans']} scans, {result['megabytes']:.0f} MB; {result['machine']}")
    print_line(f"mirrorwave process: {result['process_s']:.1f} s")
    columns = ("RATE", "KEEPS TIME", "ACHIEVED", "SECONDS", "SCANS LOST", "IDENTICAL TO PROCESS")
    rows = [
        (
            f"{row['rate']:g}", "yes" if row["realtime"] else "no", row["achieved_rate"], row["elapsed_s"],
            row["scans_lost"], "yes" if row["identical_to_process"] else "no",
        )
        for row in result["replays"]
    ]  # fmt: skip
    print_table(columns, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=Path("launch/scenes/facade_across_lane.yaml"))
    parser.add_argument("--scans", type=int, default=20)
    parser.add_argument("--rates", default="1,10,0", help="rates at which the graph is waited for")
    parser.add_argument("--realtime", default="1", help="rates at which it is not; empty for none")
    parser.add_argument("--profile", default="default")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rates = [(float(rate), False) for rate in arguments.rates.split(",") if rate]
    rates += [(float(rate), True) for rate in arguments.realtime.split(",") if rate]
    result = run(arguments.scene, arguments.scans, arguments.profile, rates)
    if arguments.json:
        print_json(result)
    else:
        print_result(result)


if __name__ == "__main__":
    main()
