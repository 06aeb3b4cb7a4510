"""What the live player of a moving scene takes of a core: processor time of all its messages over the time they last.

The player's own messages (beams, vehicle states, truth) made and encoded as its node does it, without the other nodes
and without waiting, so a busy machine does not lose beams here: it only takes longer. Figures are over scans; the least
is that of an undisturbed cache.
Usage: OPENBLAS_NUM_THREADS=1 python -m benchmarks.live.player_cores [--effects auto] [--scans 60] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import time
from pathlib import Path

import msgspec
import numpy as np

from msgs.bus.codec import encode
from msgs.bus.interface import Envelope
from nodes.player import Params, scene_events, scene_player
from sim_player.player import ScenePlayer

#: Scenes, with the speeds of all objects and of the radar where the scene stands still, m/s.
SCENES: dict[str, dict[str, float]] = {
    "launch/scenes/facade_across_lane.yaml": {"object_speed_mps": 1.0, "ego_speed_mps": 0.5},
    "launch/scenes/two_hidden_vehicles.yaml": {"object_speed_mps": 1.0, "ego_speed_mps": 0.5},
    "launch/drives/side_street.yaml": {},
}


def cores(params: Params) -> np.ndarray:
    """Return the processor time of each scan but the first over the time that a scan lasts, [scans - 1]."""
    player = scene_player(params)
    if not isinstance(player, ScenePlayer):
        raise ValueError(f"scene must be a radar's, got {params.scene!r}")
    shares, period_s = [], player.setup.radar.scan_period_s
    start_s = time.process_time()
    for event in scene_events(player, params.scans):
        topic, message = event.outgoing.topic, event.outgoing.message
        encode(Envelope(publisher="player", topic=topic, sequence=0, sent_ns=event.offset_ns), message)
        if topic == "sim/truth":
            now_s = time.process_time()
            shares.append((now_s - start_s) / period_s)
            start_s = now_s
    return np.array(shares[1:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--effects", default="auto")
    parser.add_argument("--scans", type=int, default=60)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = {}
    for name, speeds in SCENES.items():
        # a drive ends where its street does
        scans = arguments.scans if speeds else min(arguments.scans, 18)
        shares = cores(msgspec.convert({"scene": name, "effects": arguments.effects, "scans": scans, **speeds}, Params))
        quantiles = np.quantile(shares, [0.0, 0.5, 0.9, 1.0]).round(3).tolist()
        rows[Path(name).stem] = dict(zip(("least", "p50", "p90", "most"), quantiles, strict=True))
    resident_mib = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0)
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    answer = {"machine": machine, "effects": arguments.effects, "resident_mib": resident_mib, "cores": rows}
    print(json.dumps(answer) if arguments.json else json.dumps(answer, indent=2))


if __name__ == "__main__":
    main()
