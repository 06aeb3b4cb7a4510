"""The network of the specification's Table 3, at its size, against what our profiles run: milliseconds a map.

Times do not depend on weights, so Table 3's network (Swin-UNet, 512 x 512, fp32, ONNX Runtime) carries seeded random
ones; its accuracy can only be told where it has been trained (docs/results/learned.md holds the size that two
cores can train). A profile's time is its whole detection: encoding, network as often as it is asked, peaks. Every round
times every candidate once, in a drawn order, on the same map.
Usage: python -m benchmarks.accuracy.published_size [--rounds 20] [--threads 1 2] [--seed 11] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from mirrorwave.profiles import read_profile
from models.perception.detection.encoding import encode_map
from models.perception.forming.ra_former import RaFormer
from models.perception.onnx_session import open_session
from models.training.export.onnx import Exported, export_onnx
from models.training.families import preset_network
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from nodes import dense_predictor
from nodes.process.validation import convert_at
from sim_player.dataset.labelled_beams import LabelledPlace

PROFILES = ("fast", "balanced", "default", "accurate")
#: Beside Table 3's, the published U-Net, at full size.
PUBLISHED = (("swin_unet", "full"), ("unet", "full"))


class Row(msgspec.Struct, kw_only=True):
    """One candidate on so many threads."""

    name: str
    threads: int
    parameters: int | None
    p50_ms: float
    p90_ms: float
    #: Median over that of `accurate` on as many threads.
    of_accurate: float = float("nan")


def formed_map(seed: int) -> RangeAzimuthMap:
    former = RaFormer(RadarSetup())
    return next(ra_map for beam in LabelledPlace(seed, 0, "auto").beams() for ra_map in former.add(beam))


def published(
    family: str, size: str, threads: int, folder: Path, ra_map: RangeAzimuthMap
) -> tuple[int, Callable[[], Any]]:
    """Parameters of a network at its published size, and a call that asks it of an encoded map."""
    torch.manual_seed(0)
    choice, encoding = preset_network(family, size)
    network = choice.build().eval()
    path = folder / f"{family}.onnx"
    session = open_session(path, export_onnx(Exported(network), path), threads)
    feed = {session.get_inputs()[0].name: encode_map(encoding, ra_map)[None]}
    return sum(one.numel() for one in network.parameters()), partial(session.run, None, feed)


def of_profile(name: str, threads: int, ra_map: RangeAzimuthMap) -> Callable[[], Any]:
    params = read_profile(name).get("dense_predictor", {}) | {"threads": threads}
    found = convert_at(params, dense_predictor.Params, name)
    return partial(dense_predictor.detector_for(found, RadarSetup()).detect, ra_map)


def candidates(threads: int, folder: Path, ra_map: RangeAzimuthMap) -> dict[str, tuple[int | None, Callable[[], Any]]]:
    sizes = {f"{family}, {size} size": published(family, size, threads, folder, ra_map) for family, size in PUBLISHED}
    return {**sizes, **{name: (None, of_profile(name, threads, ra_map)) for name in PROFILES}}


def measured(threads: int, rounds: int, seed: int) -> list[Row]:
    with TemporaryDirectory() as folder:
        found = candidates(threads, Path(folder), formed_map(seed))
        rng, times_ms = np.random.default_rng(seed), {name: [] for name in found}
        for index in track(range(rounds + 1), f"{threads} threads", console=Console(stderr=True)):
            for name in rng.permutation(list(found)):
                start_ns = time.perf_counter_ns()
                found[name][1]()
                # the first round warms up
                if index:
                    times_ms[name].append((time.perf_counter_ns() - start_ns) / 1e6)
    rows = []
    for name, (parameters, _) in found.items():
        p50_ms, p90_ms = np.quantile(times_ms[name], (0.5, 0.9))
        ratio = float(p50_ms / np.median(times_ms["accurate"]))
        rows.append(
            Row(
                name=name,
                threads=threads,
                parameters=parameters,
                p50_ms=float(p50_ms),
                p90_ms=float(p90_ms),
                of_accurate=ratio,
            )
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = [row for threads in arguments.threads for row in measured(threads, arguments.rounds, arguments.seed)]
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    if arguments.json:
        print(json.dumps({"machine": machine, "rows": msgspec.to_builtins(rows)}, indent=1))
        return
    print(machine)
    for row in rows:
        size = "" if row.parameters is None else f"{row.parameters / 1e6:.1f} M parameters"
        print(
            f"{row.name:28s} {row.threads} thr  {row.p50_ms:8.1f} ms (p90 {row.p90_ms:.1f})  "
            f"{row.of_accurate:6.2f} x accurate  {size}"
        )


if __name__ == "__main__":
    main()
