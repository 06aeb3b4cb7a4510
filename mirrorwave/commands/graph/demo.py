"""`mirrorwave demo`: a simulated corner, the whole graph, hidden objects beside truth."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mirrorwave import early_start
from mirrorwave.completion import Profile
from mirrorwave.console import ExitCode, print_line
from msgs.files.shipped import LAUNCH

if TYPE_CHECKING:
    from mirrorwave.plots.scoreboard import Scoreboard
    from msgs.values.perception import BevFrame
    from msgs.values.radar import RangeAzimuthMap

#: Without a page this says it all; who opens the page gets time to.
UNWATCHED_S, WATCHED_S = 12.0, 120.0
DEMO_LAUNCH = LAUNCH / "demo.yaml"


def demo(
    headless: Annotated[bool, typer.Option("--headless", help="Leave out viewers.")] = False,
    duration: Annotated[
        float | None, typer.Option(metavar="S", min=1.0, help="Seconds to run [120, headless 12].")
    ] = None,
    profile: Profile = "default",
    out: Annotated[Path, typer.Option(help="Folder of the picture.")] = Path("out/demo"),
) -> None:
    """Run the demo scene live in the browser, print what it sees beside the truth, and draw the last view."""
    from mirrorwave.commands.graph.launch import run_graph
    from mirrorwave.control.launch_params import require_params
    from mirrorwave.profiles import nodes_of_file, with_profile
    from msgs.bus.zmq import run_dir
    from nodes.process.launch_file import read_launch_file

    if duration is None:
        duration = UNWATCHED_S if headless else WATCHED_S
    graph = with_profile(read_launch_file(DEMO_LAUNCH), profile)
    server = early_start.take()
    require_params(graph, nodes_of_file(profile), server)
    # a domain of its own: the demo neither disturbs a running graph nor hears it
    domain = "demo"
    watcher = Watcher(run_dir(domain))
    watcher.start()
    start_s = time.monotonic()
    try:
        code = run_graph(graph, domain, duration, headless=headless, server=server)
    finally:
        watcher.stop()
    if code != ExitCode.DONE:
        raise typer.Exit(code)
    if watcher.frame is None and time.monotonic() - start_s < duration:
        # told to end before there was anything to see
        return
    watcher.board.print_table()
    if watcher.frame is None:
        raise RuntimeError("the graph ran but published no view")
    picture = watcher.draw(out / "bev.png")
    print_line(f"wrote {picture}")


class Watcher(threading.Thread):
    """Listens to the graph from outside, as any integrator would: views, truth, maps."""

    def __init__(self, run_dir: Path) -> None:
        super().__init__(name="watcher", daemon=True)
        from mirrorwave.plots.scoreboard import Scoreboard

        self._run_dir = run_dir
        self._ended = threading.Event()
        self.board: Scoreboard = Scoreboard()
        self.frame: BevFrame | None = None
        self.ra_map: RangeAzimuthMap | None = None

    def run(self) -> None:
        """Take in messages until stopped; the bus lives in this thread alone."""
        from msgs.bus.zmq import ZmqBus

        bus = ZmqBus("demo_watcher", self._run_dir)
        try:
            for topic in ("perception/hidden_objects", "radar/ra_map", "sim/truth"):
                bus.subscribe(topic)
            while not self._ended.is_set():
                for received in bus.receive(0.1):
                    self._take(received.message)
        finally:
            bus.close()

    def stop(self) -> None:
        """End the thread."""
        self._ended.set()
        self.join()

    def draw(self, path: Path) -> Path:
        """Picture of the last view of a whole scan."""
        from mirrorwave.plots.bird_eye_view import draw_bev

        assert self.frame is not None
        path.parent.mkdir(parents=True, exist_ok=True)
        draw_bev(self.frame, path, truth=self.board.truth_of(self.frame.scan_id), ra_map=self.ra_map)
        return path

    def _take(self, message: Any) -> None:
        from msgs.values.perception import BevFrame, SceneTruth
        from msgs.values.radar import RangeAzimuthMap

        match message:
            case SceneTruth():
                self.board.add_truth(message)
            case RangeAzimuthMap():
                # the end of the demo cuts a scan short: the picture shall be of a whole one
                if self.ra_map is None or not message.missing_beams:
                    self.ra_map = message
            case BevFrame():
                if self.frame is None or "missing_beams" not in message.flags:
                    self.frame = message
                self.board.add_frame(message)
