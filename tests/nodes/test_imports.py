"""What a node's start brings along: a library that the node does not need is time in which the graph is blind."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

#: Libraries of the heavy nodes; nothing of them belongs into a node that moves messages.
HEAVY = ("numba", "scipy", "onnxruntime", "trimesh", "matplotlib", "torch", "rich", "typer")
MOVERS = (
    "nodes.player",
    "nodes.recorder",
    "nodes.recording.snapshot_recorder",
    "contrib.two_machines.link",
    "contrib.boards.phaser_radar",
    "nodes.vehicle_can",
    "nodes.can_out",
    "nodes.car_sim",
    "nodes.bev_viewer",
    "contrib.ros2.ros2_bridge",
    "nodes.process.supervisor",
)
#: Modules that one process imports in turn, and what must not have come along with them.
CHAINS = {
    "movers and detector": [
        *((module, HEAVY) for module in MOVERS),
        ("nodes.dense_predictor", ("scipy.optimize", "scipy.ndimage", "scipy.special", "scipy.fft", "scipy.sparse")),
    ],
    "radar and geometry": [
        ("nodes.ra_former", ("onnxruntime", "scipy.optimize", "scipy.ndimage", "scipy.sparse", "sim_player")),
        # what the player of a radar's scene brings along
        ("sim_player.player", ("onnxruntime", "scipy.optimize", "scipy.ndimage", "sim_player.lidar.spad")),
        ("nodes.geometry", ("onnxruntime", "scipy.ndimage", "matplotlib")),
    ],
}
PROGRAM = """
import importlib, json, sys
for module, unwanted in json.loads(sys.argv[1]):
    importlib.import_module(module)
    found = sorted({name for name in sys.modules for root in unwanted if f"{name}.".startswith(f"{root}.")})
    if found:
        sys.exit(f"{module} brought along {found[:5]}")
"""


@pytest.mark.slow
@pytest.mark.parametrize("chain", CHAINS.values(), ids=CHAINS)
def test_a_node_starts_without_what_it_does_not_need(chain: list[tuple[str, tuple[str, ...]]]) -> None:
    program = [sys.executable, "-c", PROGRAM, json.dumps(chain)]
    ended = subprocess.run(program, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
