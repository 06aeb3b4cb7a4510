"""The launch files of two hosts as they are shipped, on one machine, each graph in a domain of its own."""

from __future__ import annotations

import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.transport.link_stand import SIDES, free_port, make_keys
from tests.graph.fault_tools import ROOT, LiveGraph


def _link_options(side: str, other: str, ports: dict[str, int], keys: Path) -> list[str]:
    changes = {
        "key": keys / side / f"{side}.key_secret",
        "allowed": keys / f"of_{side}",
        "bind": f"tcp://127.0.0.1:{ports[side]}",
        f"connect.{other}.address": f"tcp://127.0.0.1:{ports[other]}",
        f"connect.{other}.key": keys / f"of_{side}" / f"{other}.key",
    }
    return [part for name, value in changes.items() for part in ("-p", f"link.{name}={value}")]


@pytest.fixture
def graphs() -> Iterator[dict[str, LiveGraph]]:
    """Both graphs, stopped in order: exit code 0."""
    with tempfile.TemporaryDirectory(prefix="mw") as name:
        root, ports = Path(name), {side: free_port() for side in SIDES}
        make_keys(root / "keys")
        running = {}
        try:
            for side, other in (SIDES, SIDES[::-1]):
                (root / side).mkdir(mode=0o700)
                options = _link_options(side, other, ports, root / "keys")
                options += ["-p", "player.chirps_per_beam=4"] if side == "sensor" else []
                running[side] = LiveGraph(ROOT / f"launch/two_hosts_{side}.yaml", root / side, *options)
            yield running
        finally:
            codes = {side: graph.close() for side, graph in running.items()}
        assert codes == dict.fromkeys(SIDES, 0)


@pytest.mark.graph
def test_maps_go_out_views_come_back_and_a_dead_link_is_replaced(graphs: dict[str, LiveGraph]) -> None:
    """Views are made on the one host of maps of the other, and come back to it; nodes of the other are seen by name.
    When a link is killed, views come again to both by themselves."""
    sensor, compute = (graphs[side] for side in SIDES)
    compute.await_views()
    sensor.await_views()
    compute.await_that("nodes of the sensor host", lambda: {"sensor.player", "sensor.ra_former"} <= set(compute.status))
    for graph in (compute, sensor):
        killed = graph.fault(signal.SIGKILL, ["link"])
        graph.await_ready(["link"], other_than=killed)
        compute.await_views()
        sensor.await_views()
