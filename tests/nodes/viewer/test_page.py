"""The page in a real browser: what stands where on the canvas, keys, words for screen readers, pause, timeline."""

from __future__ import annotations

import contextlib
import io
import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from PIL import Image

from models.scores.object_error import object_distances
from msgs.values.camera import CameraImage
from msgs.values.frames import Pose2
from msgs.values.lidar import LidarSetup
from msgs.values.perception import BevFrame, BevGrid, HiddenObject, Track
from msgs.values.radar import RadarParams, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import last_beam_ns
from nodes.viewer.assembly import Assembly
from nodes.viewer.newest import Board
from nodes.viewer.server import ViewerServer
from tests.builders import example_map, example_view
from tests.nodes.viewer.conftest import Open, leave, until
from tests.side_sensors import cloud

pytestmark = pytest.mark.graph
SCENE = "launch/scenes/parallel_street_wall.yaml"


def frame(scan_id: int, *places: tuple[float, float], visibility: int = 0) -> BevFrame:
    objects = tuple(
        HiddenObject(
            id=index, x_m=x, y_m=y, length_m=4.0, width_m=2.0, yaw_rad=0.4, score=0.9, cov_m2=((0.04, 0.0), (0.0, 0.04))
        )
        for index, (x, y) in enumerate(places)
    )
    grid, mask = BevGrid(rows=80, columns=60, cell_m=1.0), np.full((80, 60), visibility, np.uint8)
    return example_view(stamp_ns=scan_id * 300_000_000, scan_id=scan_id, objects=objects, grid=grid, visibility=mask)


def one_echo(range_m: float, azimuth_rad: float) -> RangeAzimuthMap:
    """A map with one strong spot of 5 x 15 cells."""
    grid = RangeAzimuthGrid()
    row, column = (
        round(float(grid.range_index(np.array(range_m)))),
        round(float(grid.azimuth_index(np.array(azimuth_rad)))),
    )
    values = np.ones(grid.shape, np.complex64)
    values[row - 2 : row + 3, column - 7 : column + 8] = 1000.0
    return example_map(values)


@pytest.fixture(scope="module")
def corner() -> list[Any]:
    """One scan of the demo scene through the real chain: map, peaks, truth, view, vehicle's state."""
    from models.perception.find.detectors import NetworkDetector
    from models.perception.find.onnx_model import DEFAULT_MODEL
    from models.perception.form.ra_former import RaFormer
    from models.perception.form.ra_forming import FormingParams
    from models.perception.mirrors.peaks_to_view import GeometryParams, recover_bev
    from nodes.player import Params, scene_player

    player = scene_player(Params(scene=SCENE, chirps_per_beam=8, effects="basic"))
    former = RaFormer(player.setup, FormingParams())
    (ra_map,) = [one for index in range(25) for one in former.add(player.beam(0, index), None)]
    found = NetworkDetector(player.setup, DEFAULT_MODEL).detect(ra_map)
    return [player.vehicle_state(0), ra_map, found, player.truth(0), recover_bev(found, GeometryParams())]


#: Centre of the filled area of boxes, in world coordinates, found among the canvas's own pixels.
FILLED_CENTRE = """() => {
  const canvas = document.getElementById('bev');
  const ratio = canvas.width / canvas.clientWidth;
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  const style = getComputedStyle(document.documentElement);
  const parse = (name) => style.getPropertyValue(name).trim().slice(1).match(/../g).map((part) => parseInt(part, 16));
  const [fill, paper] = [parse('--object-fill'), parse('--unknown')];
  const alpha = fill[3] / 255;
  const wanted = [0, 1, 2].map((k) => fill[k] * alpha + paper[k] * (1 - alpha));
  let [count, sx, sy] = [0, 0, 0];
  for (let i = 0; i < data.length; i += 4) {
    if ([0, 1, 2].every((k) => Math.abs(data[i + k] - wanted[k]) < 4)) {
      count += 1; sx += (i / 4) % canvas.width; sy += Math.floor(i / 4 / canvas.width);
    }
  }
  return { count, at: mirrorwave.toWorld(sx / count / ratio, sy / count / ratio) };
}"""


def test_the_hidden_car_stands_within_a_metre_of_the_truth(
    board: Board, server: ViewerServer, open_page: Open, corner: list[Any]
) -> None:
    """Read off the canvas's pixels: the drawn box against the true one, by its centre or outline (what radar sees)."""
    assembly = Assembly(board)
    for message in corner:
        assembly.take(message, 0)
    page = open_page(server)
    until(page, "mirrorwave.state.view && mirrorwave.state.view.objects.length === 1 && mirrorwave.state.map")
    for layer in ("mask", "walls", "los", "images", "truth", "map"):
        page.evaluate(f"mirrorwave.setLayer('{layer}', false)")
    until(page, "true")
    drawn = page.evaluate(FILLED_CENTRE)
    (seen,), (car,) = corner[-1].objects, [one for one in corner[3].objects if one.hidden]
    assert drawn["count"] > 200
    # the ellipse's dashes and grid lines cut a little out of the box: centre within a quarter of a metre
    assert math.dist(drawn["at"], (seen.x_m, seen.y_m)) < 0.25
    dx, dy = drawn["at"][0] - car.x_m, drawn["at"][1] - car.y_m
    along = abs(dx * math.cos(car.yaw_rad) + dy * math.sin(car.yaw_rad)) - car.length_m / 2
    across = abs(dy * math.cos(car.yaw_rad) - dx * math.sin(car.yaw_rad)) - car.width_m / 2
    outline = min(-along, -across) if max(along, across) < 0 else math.hypot(max(along, 0), max(across, 0))
    assert min(outline, math.hypot(dx, dy)) < 1.0
    assert page.locator("#objects tbody tr").count() == 1
    distances = object_distances([seen], corner[3], [car])
    errors_m = distances.centre_m[0, 0], distances.error_m[0, 0]
    assert page.locator("#objects tbody td").nth(4).inner_text() == car.object_class
    assert page.locator("#objects tbody td").nth(5).inner_text() == f"{errors_m[0]:.1f}, {errors_m[1]:.1f}\xa0m"
    assert car.object_class in page.locator("#objects tbody tr").inner_text()


def test_left_is_left_and_forward_is_up(server: ViewerServer, board: Board, open_page: Open) -> None:
    board_scan(board, 0, (20.0, 10.0))
    page = open_page(server)
    until(page, "mirrorwave.state.view")
    (ox, oy), (px, py) = page.evaluate("[mirrorwave.toCanvas(0, 0), mirrorwave.toCanvas(20, 10)]")
    assert px < ox
    assert py < oy
    assert (ox - px) / 10.0 == pytest.approx((oy - py) / 20.0)
    assert page.evaluate("mirrorwave.toWorld(...mirrorwave.toCanvas(12.5, -7.25))") == pytest.approx([12.5, -7.25])


def board_scan(board: Board, scan_id: int, *places: tuple[float, float]) -> None:
    """A scan of one and the same graph."""
    assembly = board.__dict__.setdefault("assembly", Assembly(board))
    assembly.take(frame(scan_id, *places), scan_id * 300_000_000)


def test_the_camera_and_the_lidar_stand_beside_the_view(server: ViewerServer, board: Board, open_page: Open) -> None:
    """A red image fills its panel; the slice of a cloud lies where the LiDAR saw it, turned and moved to the radar."""
    assembly = Assembly(board)
    mounted = msgspec.structs.replace(
        cloud(stamp_ns=5), vehicle_from_lidar=Pose2(1.0, 2.0, math.pi / 2), lidar_height_m=1.8
    )
    red = io.BytesIO()
    Image.new("RGB", (64, 32), (230, 0, 0)).save(red, "JPEG")
    page = open_page(server)
    assert not page.locator("#camera-section").is_visible()
    assert not page.locator("#layer-lidar").is_visible()
    for message in (mounted, CameraImage.of(red.getvalue(), 5, sensor="front"), frame(1, (20.0, 10.0))):
        assembly.take(message, 300_000_000)
    until(page, "mirrorwave.state.lidar && mirrorwave.state.bitmap && mirrorwave.state.view")
    until(page, "document.getElementById('camera').width > 0")
    assert page.locator("#camera-section").is_visible()
    assert page.locator("#layer-lidar").is_visible()
    assert page.locator("#camera-note").text_content() == "front, 64 × 32 px"
    # the wall 10 m ahead of the LiDAR, which looks to the left
    cells = page.evaluate("[...mirrorwave.state.lidar.tile.cells].map((one) => one * mirrorwave.state.lidar.tile.step)")
    assert set(np.round(cells[1::2], 1)) == {12.0}
    assert min(cells[::2]) == pytest.approx(1.0 - 5.0, abs=0.1)
    middle = page.evaluate("[byId('camera').clientWidth / 2, byId('camera').clientHeight / 2]")
    assert pixel(page, "camera", *middle) == pytest.approx((230, 0, 0), abs=12)
    at = page.evaluate(f"mirrorwave.toCanvas({cells[-2]}, {cells[-1]})")
    drawn = pixel(page, "bev", *at)
    page.evaluate("mirrorwave.setLayer('lidar', false)")
    until(page, "!mirrorwave.state.layers.lidar")
    assert pixel(page, "bev", *at) != drawn


def pixel(page: Any, canvas: str, x: float, y: float) -> list[int]:
    """Red, green and blue of a canvas at a place in CSS pixels."""
    at = "const one = document.getElementById(canvas), scale = one.width / one.clientWidth"
    read = "[...one.getContext('2d').getImageData(x * scale, y * scale, 1, 1).data].slice(0, 3)"
    found: list[int] = page.evaluate(f"([canvas, x, y]) => {{ {at}; return {read}; }}", [canvas, x, y])
    return found


@pytest.mark.parametrize(("range_m", "azimuth_deg"), [(40.0, -25.0)])
def test_an_echo_shines_where_it_came_from(
    server: ViewerServer, board: Board, open_page: Open, range_m: float, azimuth_deg: float
) -> None:
    """60 dB over noise is the top of the colour scale, a mirrored place is at the bottom; in both forms of the map."""
    assembly = Assembly(board)
    assembly.take(one_echo(range_m, math.radians(azimuth_deg)), 0)
    assembly.take(frame(0), 0)
    page = open_page(server)
    until(page, "mirrorwave.state.map")
    colour = f"""(azimuth) => {{
      const canvas = document.getElementById('map');
      const ratio = canvas.width / canvas.clientWidth;
      const [x, y] = mirrorwave.mapToCanvas({range_m}, azimuth);
      return [x, ...canvas.getContext('2d').getImageData(x * ratio, y * ratio, 1, 1).data];
    }}"""
    for form in ("cartesian", "polar"):
        page.evaluate(f"mirrorwave.setForm('{form}')")
        until(page, "true")
        x, *shining = page.evaluate(colour, math.radians(azimuth_deg))
        other_x, *dark = page.evaluate(colour, math.radians(-azimuth_deg))
        assert shining[0] > 240, form
        assert shining[2] < 90, form
        assert dark[:2] == [0, 34], form
        assert (x < other_x) == (azimuth_deg > 0), form


#: Ratio of light [pixel] of a map with an echo of some dB beside a wall of 80 dB to that of noise.
LIGHT = """([range, azimuth]) => {
  const canvas = document.getElementById('map');
  const ratio = canvas.width / canvas.clientWidth;
  const at = mirrorwave.mapToCanvas(range, azimuth).map((part) => Math.round(part * ratio));
  const parts = [...canvas.getContext('2d').getImageData(...at, 1, 1).data].slice(0, 3).map((part) => part / 255);
  const linear = parts.map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4));
  return 0.05 + linear.reduce((sum, part, k) => sum + part * [0.2126, 0.7152, 0.0722][k], 0);
}"""


def test_an_echo_of_20_db_is_seen_beside_a_wall_of_80_db(server: ViewerServer, board: Board, open_page: Open) -> None:
    """Three times as light as noise, as outlines are to be; noise alone, up to 10 dB, is as dark as nothing."""
    ra_map = one_echo(20.0, 0.0)
    values = np.ones_like(ra_map.values)
    for range_m, level_db in ((20.0, 80.0), (35.0, 20.0), (45.0, 10.0)):
        values[one_echo(range_m, 0.0).values != 1.0] = 10.0 ** (level_db / 20.0)
    assembly = Assembly(board)
    assembly.take(msgspec.structs.replace(ra_map, values=values), 0)
    assembly.take(frame(0), 0)
    page = open_page(server)
    until(page, "mirrorwave.state.map")
    wall, echo, noise, nothing = (page.evaluate(LIGHT, [range_m, 0.0]) for range_m in (20.0, 35.0, 45.0, 27.0))
    assert wall > echo > 3.0 * nothing
    assert noise == nothing


def test_pause_holds_the_scan_and_counts_what_passes(server: ViewerServer, board: Board, open_page: Open) -> None:
    page = open_page(server)
    board_scan(board, 0)
    until(page, "mirrorwave.state.view")
    page.keyboard.press("Space")
    assert page.evaluate("mirrorwave.state.paused") is True
    for scan in range(1, 8):
        board_scan(board, scan)
    until(page, "mirrorwave.state.missed === 7")
    assert page.locator("#scan").inner_text() == "0"
    assert page.locator("#missed").inner_text() == "7"
    assert page.locator("#pause").get_attribute("aria-pressed") == "true"
    page.keyboard.press("Space")
    until(page, "mirrorwave.state.view?.scan_id === 7")
    assert page.locator("#scan").inner_text() == "7"


def test_keys_do_what_they_say(server: ViewerServer, board: Board, open_page: Open) -> None:
    board_scan(board, 0)
    page = open_page(server)
    until(page, "mirrorwave.state.view")
    layers = ("mask", "walls", "los", "images", "objects", "truth", "map", "grid", "tracks", "lidar")
    for number, layer in enumerate(layers, 1):
        before = page.evaluate(f"mirrorwave.state.layers.{layer}")
        page.keyboard.press(str(number % 10))
        assert page.evaluate(f"mirrorwave.state.layers.{layer}") is (not before)
        assert page.locator(f"#layer-{layer}").is_checked() is (not before)
    page.keyboard.press("r")
    assert page.evaluate("mirrorwave.state.form") == "polar"
    scale = page.evaluate("mirrorwave.camera.scale")
    page.keyboard.press("+")
    assert page.evaluate("mirrorwave.camera.scale") == pytest.approx(1.25 * scale)
    page.keyboard.press("f")
    assert page.evaluate("mirrorwave.camera.scale") == pytest.approx(scale)
    page.keyboard.press("?")
    assert page.locator("#help").is_visible()
    page.keyboard.press("Escape")
    # a focused control keeps its own keys
    page.locator("#layer-walls").focus()
    page.keyboard.press("Space")
    assert page.evaluate("mirrorwave.state.layers.walls") is True
    assert page.evaluate("mirrorwave.state.paused") is False


def test_dark_and_light_follow_the_system_until_told(server: ViewerServer, board: Board, open_page: Open) -> None:
    board_scan(board, 0)
    corner_pixel = "[...document.getElementById('bev').getContext('2d').getImageData(3, 400, 1, 1).data].slice(0, 3)"
    shades = {}
    for scheme in ("light", "dark"):
        page = open_page(server, scheme)
        until(page, "mirrorwave.state.view")
        assert page.evaluate("mirrorwave.state.theme") == scheme
        shades[scheme] = max(page.evaluate(corner_pixel))
    assert shades["light"] > 200
    assert shades["dark"] < 60
    page.keyboard.press("t")
    assert page.evaluate("mirrorwave.state.theme") == "light"
    page.reload()
    until(page, "mirrorwave.state.view")
    assert page.evaluate("mirrorwave.state.theme") == "light"


def test_a_screen_reader_hears_what_is_seen(server: ViewerServer, board: Board, open_page: Open) -> None:
    board_scan(board, 0, (11.6, 8.5))
    page = open_page(server)
    until(page, "mirrorwave.state.announced")
    live = page.locator("[aria-live=polite]").last
    assert live.inner_text() == "1 hidden object at 11.6, 8.5 m"
    assert "11.6, 8.5 m" in (page.locator("#bev").get_attribute("aria-label") or "")
    for landmark in ("header", "main", "h1", "section[aria-labelledby]", "html[lang]", "canvas[role=img][aria-label]"):
        assert page.locator(landmark).count() > 0, landmark
    unnamed = """[...document.querySelectorAll('button, input, select')].filter((one) =>
      !(one.textContent.trim() || one.getAttribute('aria-label') || (one.labels && one.labels.length))).length"""
    assert page.evaluate(unnamed) == 0
    page.keyboard.press("Tab")
    page.keyboard.press("Tab")
    outline = "getComputedStyle(document.activeElement).outlineStyle"
    assert page.evaluate(outline) == "solid"


def test_the_page_says_which_sensor_it_looks_through(server: ViewerServer, board: Board, open_page: Open) -> None:
    """In the header of both themes and in the words of both pictures; photons have a unit of their own."""
    words = "SPAD LiDAR, 850 nm, 256 azimuths"
    assembly = Assembly(board)
    assembly.take(LidarSetup(), 0)
    assembly.take(msgspec.structs.replace(one_echo(20.0, 0.3), mode="photons"), 0)
    assembly.take(frame(0), 0)
    for scheme in ("light", "dark"):
        page = open_page(server, scheme)
        until(page, "mirrorwave.state.view && mirrorwave.state.map && mirrorwave.state.sensor")
        assert page.locator("header #sensor").inner_text() == words
        for canvas in ("bev", "map"):
            assert words in (page.locator(f"#{canvas}").get_attribute("aria-label") or "")
        assert "60 dB over ambient σ" in page.locator("#map-note").inner_text()


def test_the_vehicle_and_nodes_are_shown(server: ViewerServer, board: Board, open_page: Open) -> None:
    from msgs.values.diagnostics import NodeState, NodeStatus, ShedCount, StageTime, TopicCount

    assembly = Assembly(board)
    assembly.take(VehicleState(stamp_ns=0, speed_mps=5.0, yaw_rate_rps=0.2), 0)
    stage = StageTime(name="geometry", count=1, last_ms=15.0, mean_ms=15.0, max_ms=16.0)
    lost = TopicCount(topic="perception/peaks", messages=5, bytes=1, lost=3)
    assembly.take(
        NodeStatus(
            stamp_ns=0,
            node="geometry",
            pid=1,
            state=NodeState.DEGRADED,
            reason="<b>why</b>",
            stages=(stage,),
            received=(lost,),
            shed=(ShedCount(what="scan", reason="behind", count=7),),
        ),
        0,
    )
    assembly.take(frame(0), 0)
    late_ns = 300_000_000 + last_beam_ns() + 400_000_000
    assembly.take(frame(1), late_ns)
    assembly.post_table(late_ns)
    page = open_page(server)
    until(page, "mirrorwave.state.nodes.length && mirrorwave.state.view")
    text = page.locator("#nodes").inner_text()
    assert "left out so far: 7 scans behind" in text
    graph = page.locator("#graph")
    assert graph.inner_text().startswith("view 400 ms after its last beam")
    assert "deadline 0.3 s missed 1x" in graph.inner_text()
    assert "lossy" in (graph.get_attribute("class") or "")
    assert "geometry: 15, 16" in text
    assert "degraded" in text
    # what a node says is text, never markup
    assert "<b>why</b>" in text
    assert page.locator("#nodes .lossy").inner_text() == "3"
    assert page.evaluate("mirrorwave.state.view.vehicle.speed_mps") == 5.0


LINK = "document.getElementById('link')"
BANNER = "document.getElementById('old-picture')"


def aged(board: Board, scan_id: int, age_s: float) -> None:
    """A view that is so old when it comes, of a slow radar: its pictures stay live for 39 s."""
    assembly = board.__dict__.setdefault("assembly", Assembly(board))
    if scan_id == 0:
        assembly.take(RadarSetup(radar=RadarParams(scan_period_s=20.0)), (10**9 - 100) * 10**9)
    now_ns = (10**9 + 20 * scan_id) * 10**9
    assembly.take(msgspec.structs.replace(frame(scan_id), stamp_ns=now_ns - round(1e9 * age_s)), now_ns)


@pytest.mark.parametrize(
    ("age_s", "state", "words", "banner"),
    [
        (0.0, "live", "live", ""),
        (19.7, "late", "late", ""),
        (61.0, "old", "not live", "Old picture, "),
        (3.2e8, "old", "not live", "Old picture, 3704 days ago: played back, measured before this graph began"),
        (-5.0, "old", "not live", "Old picture: stamped by another clock"),
    ],
)
def test_only_a_picture_of_now_is_called_live(
    server: ViewerServer, board: Board, open_page: Open, age_s: float, state: str, words: str, banner: str
) -> None:
    """The colour, the words and the note in the picture follow the age of the measurement, whatever has just come."""
    aged(board, 0, 0.0)
    aged(board, 1, age_s)
    page = open_page(server)
    until(page, "mirrorwave.state.view?.scan_id === 1")
    assert (page.evaluate(f"{LINK}.dataset.state"), page.evaluate(f"{LINK}.textContent")) == (state, words)
    assert page.evaluate(f"!{BANNER}.hidden") == bool(banner)
    assert page.evaluate(f"{BANNER}.textContent").startswith(banner)
    assert page.evaluate(f"getComputedStyle({BANNER}).backgroundColor") == "rgb(179, 38, 30)", "red"
    assert (page.evaluate("ageOf(mirrorwave.state.view, mirrorwave.state.viewAt)") or -5e3) >= 1e3 * age_s


def test_the_rule_of_the_page_at_its_limits(server: ViewerServer, open_page: Open) -> None:
    page = open_page(server)
    limits = "{ late_ms: 888.7, old_ms: 1000 }"
    cases = {
        "0": "live",
        "888.7": "live",
        "888.8": "late",
        "1000": "late",
        "1000.1": "old",
        "1e12": "old",
        "null": "old",
    }
    for age_ms, state in cases.items():
        assert page.evaluate(f"mirrorwave.freshness({age_ms}, {limits})") == state, age_ms
    assert page.evaluate("mirrorwave.freshness(0.1, { late_ms: 0, old_ms: 1000 })") == "late"


def test_what_took_long_to_come_is_as_old_as_it_is(server: ViewerServer, open_page: Open) -> None:
    """An update that left the viewer 5 s ago; and one on a clock that fell behind is not held back for ever."""
    page = open_page(server)
    late_ms = "(() => { const sent = viewerNow() - 5000; hearClock(sent); return viewerNow() - sent; })()"
    assert page.evaluate(late_ms) == pytest.approx(5000.0, abs=50.0)
    early_ms = "(() => { const sent = viewerNow() + 5000; hearClock(sent); return viewerNow() - sent; })()"
    assert page.evaluate(early_ms) == pytest.approx(0.0, abs=50.0)


def test_age_counts_on_when_nothing_comes(server: ViewerServer, board: Board, open_page: Open) -> None:
    """The label turns by itself, the note says which node has ended, and a paused page does not call itself live."""
    from msgs.values.diagnostics import NodeState, NodeStatus

    board_scan(board, 0)
    page = open_page(server)
    until(page, f"{LINK}.textContent === 'not live'")
    until(page, f"{BANNER}.textContent.endsWith('no new view comes')")
    before = page.evaluate("parseFloat(document.getElementById('age').textContent)")
    until(page, f"parseFloat(document.getElementById('age').textContent) > {before}")
    assembly: Assembly = board.__dict__["assembly"]
    assembly.take(NodeStatus(stamp_ns=0, node="player", pid=1, state=NodeState.STOPPING), 0)
    assembly.post_table(0)
    until(page, f"{BANNER}.textContent.endsWith('player has ended')")
    page.keyboard.press("Space")
    until(page, f"{LINK}.textContent === 'paused' && {LINK}.dataset.state === 'old'")


def test_the_page_says_when_the_graph_has_gone(board: Board, open_page: Open) -> None:
    server = ViewerServer(board, title="short")
    page = open_page(server)
    server.close()
    until(page, "document.getElementById('link').textContent === 'the graph has ended'")
    leave(page)


@contextlib.contextmanager
def played(path: Path) -> Iterator[ViewerServer]:
    """A recording under the page, as `mirrorwave view` serves it."""
    from mirrorwave.replay.playback import Playback
    from msgs.recording.mcap import RecordingReader

    board = Board()
    with RecordingReader(path) as reader:
        playback = Playback(reader, board)
        ended = threading.Event()

        def run() -> None:
            while not ended.is_set():
                playback.turn(time.monotonic())

        thread = threading.Thread(target=run)
        thread.start()
        try:
            with ViewerServer(board, title=path.name, commands=playback.commands.put) as server:
                yield server
        finally:
            ended.set()
            thread.join()


def test_a_recording_is_moved_by_keys_and_slider(tmp_path: Path, open_page: Open) -> None:
    from tests.mirrorwave.commands.captures.test_view import SCANS, write_recording

    with played(write_recording(tmp_path / "a.mcap")) as server:
        page = open_page(server)
        until(page, "mirrorwave.state.timeline")
        assert page.locator("#timeline").is_visible()
        keys = (".", 101), (".", 102), (",", 101), ("End", 99 + SCANS), ("ArrowLeft", 98 + SCANS)
        for key, scan in (*keys, ("Shift+ArrowLeft", 88 + SCANS), ("Home", 100), ("ArrowRight", 101)):
            page.keyboard.press(key)
            until(page, f"mirrorwave.state.view.scan_id === {scan}")
        page.locator("#seek").fill("9")
        until(page, "mirrorwave.state.view?.scan_id === 109")
        # the slider that was moved last does not keep the space bar to itself
        page.locator("#speed").select_option("4")
        page.locator("#seek").focus()
        page.keyboard.press("Space")
        until(page, f"mirrorwave.state.view.scan_id === {99 + SCANS} && !mirrorwave.state.timeline.playing")
        page.keyboard.press("l")
        assert page.locator("#loop").get_attribute("aria-pressed") == "true"
        page.keyboard.press("Space")
        until(page, "mirrorwave.state.timeline.loop && mirrorwave.state.timeline.playing")
        leave(page)


def test_a_recording_shows_where_its_warnings_are(tmp_path: Path, open_page: Open) -> None:
    """Marks above the slider: seen, hovered, jumped to, dragged over; the slider stays within its limits."""
    from tests.mirrorwave.commands.captures.test_view import DRIVE_SCANS, REST_SCANS, write_drive

    with played(write_drive(tmp_path / "drive.mcap")) as server:
        page = open_page(server)
        until(page, "mirrorwave.state.overview && mirrorwave.state.timeline")
        starts = page.evaluate(
            "mirrorwave.state.overview.marks.filter((one) => one.level !== 'notice').map((one) => one.from_s)"
        )
        page.keyboard.press("n")
        until(page, "mirrorwave.state.timeline.index > 0")
        assert page.evaluate("mirrorwave.state.timeline.time_s") == pytest.approx(min(one for one in starts if one > 0))
        first = page.evaluate("mirrorwave.state.timeline.index")
        page.keyboard.press("n")
        until(page, f"mirrorwave.state.timeline.index > {first}")
        page.keyboard.press("p")
        until(page, f"mirrorwave.state.timeline.index === {first}")
        box = page.locator("#strip").bounding_box()
        page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 10)
        assert "Hidden road user from the left: about to appear" in page.locator("#hover").inner_text()
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] + 50, box["y"] + 10, steps=4)
        page.mouse.up()
        until(page, f"mirrorwave.state.view.scan_id === {REST_SCANS + DRIVE_SCANS - 1}")
        assert "first at" in page.locator("#warning-list").inner_text()
        leave(page)


def road_user(identity: int, x_m: float, y_m: float, **changes: Any) -> Track:
    facts: dict[str, Any] = {
        "velocity_x_mps": 0.0, "velocity_y_mps": -4.0, "age_s": 3.0, "cov_m2": ((0.3, 0.0), (0.0, 0.2)),
        "velocity_cov_m2ps2": ((0.5, 0.0), (0.0, 0.5)), "time_to_appear_s": 2.4, "existence": 0.968,
    }  # fmt: skip
    return Track(id=identity, x_m=x_m, y_m=y_m, **{**facts, **changes})


def board_tracks(board: Board, scan_id: int, *tracks: Track) -> None:
    """A scan with tracks, of a vehicle at rest."""
    assembly = board.__dict__.setdefault("assembly", Assembly(board))
    now_ns = scan_id * 300_000_000
    assembly.take(VehicleState(stamp_ns=now_ns), now_ns)
    assembly.take(msgspec.structs.replace(frame(scan_id, visibility=2), tracks=tracks), now_ns)


PIXEL = """([x, y]) => {
  const canvas = document.getElementById('bev');
  const ratio = canvas.width / canvas.clientWidth;
  const [px, py] = mirrorwave.toCanvas(x, y);
  const got = [...canvas.getContext('2d').getImageData(px * ratio, py * ratio, 1, 1).data].slice(0, 3);
  const wanted = getComputedStyle(document.documentElement).getPropertyValue('--track').trim().slice(1);
  return got.every((part, k) => Math.abs(part - parseInt(wanted.slice(2 * k, 2 * k + 2), 16)) < 12);
}"""


def test_a_track_stands_at_its_place_with_its_trail_and_its_way(
    server: ViewerServer, board: Board, open_page: Open
) -> None:
    for scan in range(6):
        one = road_user(3, 25.0, 16.0 - 1.2 * scan, time_to_appear_s=2.4 - 0.3 * scan)
        # one is far outside the picture, and known for ever
        board_tracks(board, scan, one, road_user(2**60, 3000.0, -8000.0, age_s=1e6, time_to_appear_s=None))
    page = open_page(server)
    until(page, "mirrorwave.state.view && mirrorwave.state.view.tracks.length === 2")
    page.evaluate("mirrorwave.setLayer('mask', false)")
    until(page, "true")
    for place in ((25.0, 10.0), (25.0, 14.8), (25.0, 11.2)):
        assert page.evaluate(PIXEL, list(place)), place
    for place in ((25.0, 18.0), (25.0, -10.0), (20.0, 10.0)):
        assert not page.evaluate(PIXEL, list(place)), place
    rows = page.locator("#tracks tbody tr")
    assert rows.count() == 2
    text = rows.first.inner_text().replace("\xa0", " ")
    for part in ("T3 97 %", "25.0, 10.0 m", "4.0 ± 1.4 m/s, 14 km/h", "90° right", "in 0.9 s", "3.0 s"):
        assert part in text
    assert "16667\xa0min" in rows.nth(1).inner_text()


BOXES_OF_URGENT = """() => {
  const list = document.querySelector('#warning-list');
  const parts = list.querySelectorAll('[data-level=urgent] :is(.sign, .title, .left)');
  return [list, [...parts]].map((one) => Array.isArray(one) ? one.map((part) => part.getBoundingClientRect().toJSON())
    : one.getBoundingClientRect().toJSON());
}"""


def test_no_track_one_and_a_thousand(server: ViewerServer, board: Board, open_page: Open) -> None:
    page = open_page(server)
    board_tracks(board, 0)
    until(page, "mirrorwave.state.view")
    assert page.locator("#tracks").inner_text().endswith("none followed")
    rng = np.random.default_rng(0)
    places = rng.uniform(-80.0, 80.0, (1000, 2)).tolist()
    board_tracks(board, 1, *(road_user(index, x, y) for index, (x, y) in enumerate(places)))
    until(page, "mirrorwave.state.view?.tracks_total === 1000")
    assert page.locator("#tracks tbody tr").last.inner_text().startswith("and 988 more")
    assert page.locator("#warning-list li").count() <= 12
    # several urgent ones at once: no word of what they are and no time left lies out of sight
    until(page, "document.querySelectorAll('#warning-list [data-level=urgent]').length >= 3")
    # in one go: the list is drawn again with every view
    banner, parts = page.evaluate(BOXES_OF_URGENT)
    assert len(parts) >= 3
    for box in parts:
        assert box["left"] >= banner["left"]
        assert box["right"] <= banner["right"]
        assert box["top"] >= banner["top"]
        assert box["bottom"] <= banner["bottom"]
    said = page.locator("#alarm").inner_text()
    for words in ("behind: about to appear", "from the right: about to appear", "from the left: ways meet"):
        assert words in said


CONTRAST = """() => [...document.querySelectorAll('.warnings li:not(.ended) .title')].map((one) => {
  const light = (text) => text.match(/[0-9.]+/g).slice(0, 3).map((part) => part / 255)
    .map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4))
    .reduce((sum, part, k) => sum + part * [0.2126, 0.7152, 0.0722][k], 0);
  const style = getComputedStyle(one.closest('li'));
  const [a, b] = [light(style.color), light(style.backgroundColor)];
  return (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
})"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_warnings_are_told_by_shape_word_and_place_not_by_colour_alone(
    server: ViewerServer, board: Board, open_page: Open, scheme: str
) -> None:
    page = open_page(server, scheme, motion="reduce")
    until(page, "document.querySelector('#warning-list .calm')")
    for scan in range(4):
        board_tracks(board, scan, road_user(3, 25.0, 16.0, time_to_appear_s=2.4 - 0.3 * scan))
    state = VehicleState(stamp_ns=0, valid=False, reason="<b>counter</b>")
    board.__dict__["assembly"].take(state, 900_000_000)
    board.__dict__["assembly"].post_table(900_000_000)
    until(page, "mirrorwave.state.warnings.length === 2")
    items = page.locator("#warning-list li")
    assert [item.get_attribute("data-level") for item in items.all()] == ["urgent", "caution"]
    assert [sign.get_attribute("aria-label") for sign in page.locator(".warnings .sign").all()] == ["Urgent", "Caution"]
    assert len({sign.inner_text() for sign in page.locator(".warnings .sign").all()}) == 2
    first = items.first.inner_text()
    assert "Hidden road user from the left: about to appear" in first
    assert "1.5 s" in first
    # what a vehicle says is text, never markup
    assert "<b>counter</b>" in items.nth(1).inner_text()
    assert min(page.evaluate(CONTRAST)) >= 4.5
    # from a distance: the title of an urgent warning is more than half as large again as the page's text
    size = "parseFloat(getComputedStyle(document.querySelector('[data-level=urgent] .title')).fontSize)"
    assert page.evaluate(size) >= 22
    # what moves for attention does not where that is not wanted, and nothing sounds unasked
    assert page.evaluate("getComputedStyle(document.querySelector('#warning-list li')).animationName") == "none"
    assert page.locator("#sound").get_attribute("aria-pressed") == "false"
    assert page.locator("#alarm").inner_text().startswith("Hidden road user from the left: about to appear in")
    page.keyboard.press("s")
    assert page.locator("#sound").inner_text().endswith("on")


def test_warnings_that_nobody_renews_are_called_out_of_date(board: Board, open_page: Open) -> None:
    server = ViewerServer(board, title="short")
    board_tracks(board, 0, road_user(3, 25.0, 16.0))
    page = open_page(server)
    until(page, "document.querySelector('[data-level=urgent]')")
    server.close()
    until(page, "document.getElementById('warning-list').textContent.includes('Warnings are out of date')")
    assert page.locator("#warning-list li").count() == 1
    leave(page)


def test_what_peers_say_is_text_and_never_markup(board: Board, open_page: Open) -> None:
    """Names, reasons, flags and titles of a hostile peer: no element of theirs, no script, no violated policy."""
    from msgs.values.diagnostics import NodeState, NodeStatus, ShedCount, StageTime
    from msgs.values.perception import SceneTruth, TruthObject

    evil = "<img src=x onerror=alert(1)><script>window.evil = 1</script>"
    none = np.zeros((0, 3), np.float32)
    car = TruthObject(id=0, object_class=evil, x_m=10.0, y_m=5.0, yaw_rad=0.0, length_m=4.0, width_m=2.0, hidden=True)
    assembly = Assembly(board)
    status = NodeStatus(
        stamp_ns=0, node=evil, pid=1, state=NodeState.DEGRADED, reason=evil,
        stages=(StageTime(name=evil, count=1, last_ms=1.0, mean_ms=1.0, max_ms=1.0),),
        shed=(ShedCount(what=evil, reason=evil, count=1),),
    )  # fmt: skip
    truth = SceneTruth(
        stamp_ns=0, scan_id=0, los_points_m=none, mirrored_points_m=none, hidden_points_m=none,
        hidden_object=np.zeros(0, np.int32), objects=(car,),
    )  # fmt: skip
    state = VehicleState(stamp_ns=0, valid=False, reason=evil)
    view = msgspec.structs.replace(frame(0, (10.0, 5.0)), flags=(evil,))
    for message in (state, truth, status, one_echo(20.0, 0.3), view):
        assembly.take(message, 0)
    assembly.post_table(0)
    with ViewerServer(board, title=evil) as server:
        page = open_page(server)
        until(page, "mirrorwave.state.nodes.length && mirrorwave.state.view && mirrorwave.state.warnings.length")
        assert page.locator("img").count() == 0
        assert page.locator("script").count() == 3
        assert page.evaluate("window.evil") is None
        for place in ("#title", "#nodes", "#warning-list"):
            assert evil in page.locator(place).inner_text().replace("\n", " "), place
        leave(page)


def test_the_page_could_not_make_markup_of_text_if_it_tried(server: ViewerServer, browser: Any) -> None:
    page = browser.new_page()
    page.goto(server.url)
    attempt = "(() => { try { document.body.innerHTML = 'x'; return ''; } catch (error) { return error.name; } })()"
    assert page.evaluate(attempt) == "TypeError"
    page.close()
