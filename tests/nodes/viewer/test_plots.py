"""Plots of numbers over time in a real browser: live and of a recording, kept, removed, gaps, odd values."""

from __future__ import annotations

import json
import math
import threading
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from mirrorwave.replay.playback import Playback
from msgs.recording.mcap import RecordingReader
from msgs.values.diagnostics import NodeState, NodeStatus, StageTime
from msgs.values.vehicle import VehicleState
from nodes.viewer.assembly import Assembly
from nodes.viewer.newest import Board
from nodes.viewer.numeric_fields import numeric_fields
from nodes.viewer.series import SeriesStore
from nodes.viewer.server import ViewerServer
from tests.mirrorwave.commands.captures.test_view import SCANS, write_recording
from tests.nodes.viewer.conftest import Open, until
from tests.nodes.viewer.test_page import frame

pytestmark = pytest.mark.graph
PERIOD_NS = 300_000_000

#: Pixels of a plot's own canvas that have the colour of its line.
INK = """(index) => {
  const chart = mirrorwave.plots.shown[index].chart;
  const { data } = chart.ctx.getImageData(0, 0, chart.ctx.canvas.width, chart.ctx.canvas.height);
  const [r, g, b] = chart.series[1].stroke().slice(1).match(/../g).map((part) => parseInt(part, 16));
  let count = 0;
  for (let i = 0; i < data.length; i += 4) {
    count += Math.abs(data[i] - r) + Math.abs(data[i + 1] - g) + Math.abs(data[i + 2] - b) < 12 && data[i + 3] > 200;
  }
  return count;
}"""


@pytest.fixture
def open_page(open_page: Open) -> Open:
    """Pages that plot nothing at first."""
    return partial(open_page, kept="[]")


def status(scan: int, mean_ms: float) -> NodeStatus:
    stages = (StageTime(name="geometry", count=2, last_ms=mean_ms, mean_ms=mean_ms, max_ms=2.0 * mean_ms),)
    return NodeStatus(
        stamp_ns=scan * PERIOD_NS, node="geometry", pid=1, state=NodeState.READY, uptime_s=0.3 * scan, stages=stages
    )


def run_graph(board: Board, scans: range, has_node: bool = True) -> None:
    """Views, a vehicle and a node; the viewer's own pace."""
    assembly = board.__dict__.setdefault("assembly", Assembly(board))
    for scan in scans:
        now_ns = scan * PERIOD_NS
        places = ((20.0, 10.0),) * (scan % 3)
        assembly.take(VehicleState(stamp_ns=now_ns, speed_mps=float(scan)), now_ns)
        if has_node:
            assembly.take(status(scan, 3.0 + scan), now_ns)
        assembly.take(frame(scan, *places), now_ns)
        assembly.post_table(now_ns)


def plot(page: Any, group: str, field: str) -> None:
    until(page, f"mirrorwave.plots.fields.some(([, group, field]) => group === '{group}' && field === '{field}')")
    page.evaluate("document.activeElement.blur()")
    until(page, f"[...document.getElementById('plot-group').options].some((one) => one.value === '{group}')")
    page.select_option("#plot-group", group)
    page.select_option("#plot-field", field)
    page.click("#plot-add")


def values_of(page: Any, index: int = 0) -> list[float | None]:
    return page.evaluate(f"(mirrorwave.plots.shown[{index}].data || {{ v: [] }}).v")


def test_numbers_of_vehicle_views_and_nodes_are_plotted_as_they_come(
    board: Board, server: ViewerServer, open_page: Open
) -> None:
    run_graph(board, range(10))
    page = open_page(server)
    plot(page, "vehicle/state", "speed_mps")
    plot(page, "perception/hidden_objects", "objects.count")
    plot(page, "node geometry", "stages.geometry.mean_ms")
    until(page, "mirrorwave.plots.shown.every((one) => one.data && one.data.v.length)")
    assert values_of(page, 0) == [float(scan) for scan in range(10)]
    assert values_of(page, 1) == [float(scan % 3) for scan in range(10)]
    assert values_of(page, 2) == [3.0 + scan for scan in range(10)]
    run_graph(board, range(10, 20))
    until(page, "mirrorwave.plots.shown[0].data.v.length === 20")
    assert page.evaluate("mirrorwave.plots.shown[0].data.t.at(-1)") == 0
    assert page.evaluate("mirrorwave.plots.shown[0].data.t[0]") == pytest.approx(-0.3 * 19)
    assert page.locator("#plots .plot-value").all_inner_texts() == ["19", "1", "22"]
    for index in range(3):
        assert page.evaluate(INK, index) > 60


def test_a_page_opens_with_plots_and_stays_without_those_that_were_removed(
    board: Board, server: ViewerServer, open_page: Open
) -> None:
    run_graph(board, range(5))
    page = open_page(server, kept="null")
    until(page, "mirrorwave.plots.shown.length === 2 && mirrorwave.plots.shown.every((one) => one.data)")
    names = page.locator("#plots .plot-name").all_inner_texts()
    assert names == [f"perception/hidden_objects {field}" for field in ("latency_ms", "objects.count")]
    assert values_of(page, 1) == [float(scan % 3) for scan in range(5)]
    for _ in names:
        page.click("#plots button")
    page.reload()
    until(page, "mirrorwave.plots.fields.length")
    assert page.locator("#plots li").count() == 0


def test_nothing_is_sent_to_a_page_that_plots_nothing(board: Board, server: ViewerServer, open_page: Open) -> None:
    run_graph(board, range(5))
    page = open_page(server)
    until(page, "mirrorwave.plots.fields.length && mirrorwave.state.view.scan_id === 4")
    assert page.evaluate("mirrorwave.plots.data.size") == 0
    plot(page, "vehicle/state", "speed_mps")
    until(page, "mirrorwave.plots.data.size === 1")
    page.click("#plots button")
    assert page.locator("#plots li").count() == 0
    run_graph(board, range(5, 8))
    until(page, "mirrorwave.state.view?.scan_id === 7")
    assert page.evaluate("mirrorwave.plots.now") == 0
    assert page.evaluate("[...mirrorwave.plots.data.values()][0].v.length") == 5


def test_a_gap_a_nan_and_an_infinity_interrupt_the_line(board: Board, server: ViewerServer, open_page: Open) -> None:
    odd = {3: math.nan, 4: math.inf, 5: -math.inf, 6: 1e300}
    for scan in range(10):
        board.series.take("odd", numeric_fields({"value": odd.get(scan, 2.0)}), scan * PERIOD_NS)
    board.post_series()
    page = open_page(server)
    plot(page, "odd", "value")
    until(page, "mirrorwave.plots.shown[0].data")
    assert values_of(page) == [2.0] * 3 + [None] * 4 + [2.0] * 3
    scale = page.evaluate("(({ min, max }) => [min, max])(mirrorwave.plots.shown[0].chart.scales.y)")
    assert scale == pytest.approx([1.8, 2.2])


def test_a_node_that_ends_leaves_its_line_behind(board: Board, server: ViewerServer, open_page: Open) -> None:
    run_graph(board, range(5))
    page = open_page(server)
    plot(page, "node geometry", "stages.geometry.mean_ms")
    run_graph(board, range(5, 30), has_node=False)
    until(page, "mirrorwave.state.view?.scan_id === 29 && mirrorwave.plots.shown[0].data.t.at(-1) < -4")
    assert page.locator("#plots li").count() == 1


def test_plots_are_kept_and_a_field_that_is_not_there_is_named_so(
    board: Board, server: ViewerServer, open_page: Open
) -> None:
    run_graph(board, range(5))
    page = open_page(server)
    plot(page, "vehicle/state", "speed_mps")
    kept = json.dumps([["vehicle/state", "speed_mps"], ["gone", "x"]])
    page.evaluate(f"localStorage.setItem('mirrorwave.plots', '{kept}')")
    again = open_page(server, beside=page)
    until(again, "mirrorwave.plots.shown.length === 2 && mirrorwave.plots.shown[0].data")
    assert again.locator("#plots .plot-name").all_inner_texts() == ["vehicle/state speed_mps", "gone x"]
    assert again.locator("#plots .plot-value").all_inner_texts() == ["4", "not measured"]
    again.evaluate("localStorage.setItem('mirrorwave.plots', '{\"no\": [list')")
    third = open_page(server, beside=page)
    assert third.locator("#plots li").count() == 0


def test_no_more_plots_than_the_server_takes(board: Board, server: ViewerServer, open_page: Open) -> None:
    run_graph(board, range(5))
    page = open_page(server)
    until(page, "mirrorwave.plots.fields.length > 10")
    fields = page.evaluate("mirrorwave.plots.fields.filter(([, group]) => group === 'perception/hidden_objects')")
    for _, group, field in fields[:10]:
        plot(page, group, field)
    plot(page, fields[0][1], fields[0][2])
    assert page.locator("#plots li").count() == 6
    until(page, "mirrorwave.plots.data.size === 6")
    assert page.evaluate("mirrorwave.state.connection") == "live"


def test_a_recording_shows_its_whole_span_and_a_click_goes_there(tmp_path: Path, open_page: Open) -> None:
    with RecordingReader(write_recording(tmp_path / "a.mcap")) as reader:
        board = Board(SeriesStore(keeps_all=True))
        playback = Playback(reader, board)
        with ViewerServer(board, title="a.mcap", commands=playback.commands.put) as server:
            threading.Thread(target=playback.run, daemon=True).start()
            page = open_page(server)
            plot(page, "vehicle/state", "speed_mps")
            until(page, "mirrorwave.plots.shown[0].data && mirrorwave.plots.shown[0].data.v.length")
            assert values_of(page) == [float(scan) for scan in range(SCANS)]
            assert page.locator("#plots .plot-value").inner_text() == "0"
            page.evaluate("window.scrollTo(0, 0)")
            over = page.locator("#plots .u-over")
            over.scroll_into_view_if_needed()
            box = over.bounding_box()
            over.click(position={"x": 0.75 * box["width"], "y": box["height"] / 2})
            until(page, "mirrorwave.state.timeline.index === 14")
            page.mouse.move(5, 5)
            page.keyboard.press("End")
            until(page, "document.querySelector('#plots .plot-value').textContent === '19'")


def test_a_plot_is_named_for_screen_readers(board: Board, server: ViewerServer, open_page: Open) -> None:
    run_graph(board, range(5))
    page = open_page(server)
    plot(page, "vehicle/state", "speed_mps")
    until(page, "mirrorwave.plots.shown[0].data")
    label = page.locator("#plots [role=img]").get_attribute("aria-label")
    assert label == "vehicle/state speed_mps over time: 4, 0 to 4"
    assert page.get_by_label("Remove the plot of vehicle/state speed_mps").count() == 1
