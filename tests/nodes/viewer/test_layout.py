"""The page's layout in a real browser: no sideways scrolling on a phone, the timeline over the full width."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import msgspec
import pytest

from msgs.values.diagnostics import NodeState, NodeStatus, ShedCount, StageTime, TopicCount
from msgs.values.vehicle import VehicleState
from nodes.viewer.assembly import Assembly
from nodes.viewer.newest import Board
from nodes.viewer.server import ViewerServer
from tests.nodes.viewer import test_page
from tests.nodes.viewer.conftest import Open, leave, resize, until

pytestmark = pytest.mark.graph
PHONE, TABLET, DESK = 400, 800, 1440


@pytest.fixture
def open_page(open_page: Open) -> Open:
    return partial(open_page, height=860)


def busy_board(urgent: int = 2) -> Board:
    """A view with everything that needs room: objects, tracks, urgent and other warnings, nodes with reasons."""
    board = Board()
    for scan in range(4):
        tracks = (
            test_page.road_user(3, 25.0, 16.0, time_to_appear_s=2.4 - 0.3 * scan),
            test_page.road_user(12, 30, -9),
        )
        test_page.board_tracks(board, scan, *tracks)
    assembly: Assembly = board.__dict__["assembly"]
    stage = StageTime(name="dense_predictor", count=1, last_ms=15.0, mean_ms=115.0, max_ms=316.0)
    lost = TopicCount(topic="perception/hidden_objects", messages=5, bytes=1, lost=3000)
    for node in ("ra_former", "dense_predictor", "geometry"):
        assembly.take(
            NodeStatus(
                stamp_ns=0, node=node, pid=1, state=NodeState.DEGRADED, reason="a reason of some length " * 2,
                stages=(stage,), received=(lost,), published=(lost,),
                shed=(ShedCount(what="scan", reason="behind", count=7),),
            ),
            900_000_000,
        )  # fmt: skip
    assembly.take(VehicleState(stamp_ns=0, valid=False, reason="no speed since 3 s"), 900_000_000)
    assembly.take(test_page.frame(4, (11.6, 8.5), (22.0, -13.75)), 1_200_000_000)
    assembly.post_table(1_200_000_000)
    return board


#: Elements with text that reach beyond the screen or their own box; those for screen readers alone are not shown.
CUT = """() => [...document.querySelectorAll('header *, .warnings *, main *, footer *')].filter((one) => {
  const box = one.getBoundingClientRect();
  if (!box.width || one.closest('.unseen') || one.tagName === 'OPTION') return false;
  const text = [...one.childNodes].some((part) => part.nodeType === 3 && part.textContent.trim());
  const clipped = text && one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).overflowX !== 'visible';
  return box.right > document.documentElement.clientWidth + 0.5 || box.left < -0.5 || clipped;
}).map((one) => `${one.tagName}#${one.id}.${one.className} ${one.textContent.trim().slice(0, 40)}`)"""


def test_a_narrow_page_scrolls_up_and_down_alone(open_page: Open) -> None:
    with ViewerServer(busy_board(), title="a title of some length") as server:
        page = open_page(server, "light", 320)
        until(page, "mirrorwave.plots.shown.every((one) => one.data)")
        until(page, "mirrorwave.state.view && mirrorwave.state.nodes.length === 3")
        until(page, "mirrorwave.state.warnings.length >= 2")
        for scheme, width in (("light", 320), ("dark", PHONE), ("light", TABLET)):
            resize(page, width, scheme)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert page.evaluate("document.body.scrollWidth") <= width
            assert page.evaluate(CUT) == []
            inside = "[...document.querySelectorAll('section')].filter((one) => one.scrollWidth > one.clientWidth + 1)"
            assert page.evaluate(f"{inside}.length") == 0
            page.keyboard.press("?")
            box = page.locator("#help").bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= width
            fits = "document.getElementById('help').scrollWidth <= document.getElementById('help').clientWidth"
            assert page.evaluate(fits)
            page.keyboard.press("Escape")


#: Words that stand in more than one line: parts of it have boxes at different heights.
BROKEN = """() => [...document.querySelectorAll('#nodes, #tracks, #objects')].flatMap((table) => {
  const walker = document.createTreeWalker(table, NodeFilter.SHOW_TEXT);
  const words = [];
  while (walker.nextNode()) for (const match of walker.currentNode.data.matchAll(/[\\w.]+/g)) {
    const range = document.createRange();
    range.setStart(walker.currentNode, match.index);
    range.setEnd(walker.currentNode, match.index + match[0].length);
    if (new Set([...range.getClientRects()].map((box) => Math.round(box.top))).size > 1) words.push(match[0]);
  }
  return words;
})"""


def test_no_word_of_a_table_is_broken(open_page: Open) -> None:
    with ViewerServer(busy_board(), title="words") as server:
        page = open_page(server, "light", PHONE)
        until(page, "mirrorwave.state.view && mirrorwave.state.nodes.length === 3")
        for width in (PHONE, DESK):
            resize(page, width)
            assert page.evaluate(BROKEN) == []
        # the measure itself
        narrow = "max-width: 40px; word-break: break-all; white-space: normal"
        page.evaluate(f"document.querySelector('#nodes td').style.cssText = '{narrow}'")
        assert page.evaluate(BROKEN) != []


def test_what_stays_in_place_leaves_a_phone_its_picture(tmp_path: Path, open_page: Open) -> None:
    """Two thirds of the screen are free between warnings and timeline; its last row is reached at the page's end."""
    from tests.mirrorwave.commands.captures.test_view import write_drive

    with test_page.played(write_drive(tmp_path / "drive.mcap")) as server:
        page = open_page(server, "light", PHONE)
        until(page, "mirrorwave.state.overview && mirrorwave.state.timeline")
        page.keyboard.press("End")
        until(page, "mirrorwave.state.warnings.some((one) => one.level === 'urgent')")
        page.evaluate("window.scrollTo(0, 400)")
        height = page.viewport_size["height"]
        warnings, timeline = (page.locator(one).bounding_box() for one in ("#warnings", "#timeline"))
        assert warnings["y"] == pytest.approx(0.0, abs=0.5)
        assert timeline["y"] - warnings["height"] > 0.66 * height
        for button in ("#back", "#play", "#forward", "#clock"):
            box = page.locator(button).bounding_box()
            assert box["y"] + box["height"] <= height
        page.evaluate("window.scrollTo(0, document.body.scrollHeight)")
        last = page.locator("#loop").bounding_box()
        assert last["y"] + last["height"] <= height
        leave(page)


def test_nodes_stand_above_the_fold_of_a_desk(open_page: Open) -> None:
    with ViewerServer(busy_board(), title="desk") as server:
        page = open_page(server, "light", 1400)
        until(page, "mirrorwave.state.nodes.length === 3")
        box = page.locator("#nodes tbody tr:not(.reason)").last.bounding_box()
        assert box["y"] + box["height"] <= page.viewport_size["height"]


def test_labels_stand_at_their_boxes_and_cover_none(open_page: Open) -> None:
    """Of two objects, one under a track: each label is the nearest free place to what it names."""
    board = Board()
    view = test_page.frame(0, (11.6, 8.5), (22.0, -7.0))
    track = test_page.road_user(3, 22.0, -7.0, time_to_appear_s=None)
    Assembly(board).take(msgspec.structs.replace(view, tracks=(track,)), 0)
    with ViewerServer(board, title="labels") as server:
        page = open_page(server, "light", DESK)
        until(page, "mirrorwave.state.labels.length === 3")
        labels = page.evaluate("mirrorwave.state.labels")
        boxes = [label["box"] for label in labels[:2]]
        assert [label["text"].split()[0] for label in labels] == ["#0", "#1", "T3"]
        for (left, top, right, bottom), (x, y, x_end, y_end) in ((one["box"], one["spot"]) for one in labels[:2]):
            assert max(left - x_end, x - right, top - y_end, y - bottom) == pytest.approx(3.0)
        spots = [label["spot"] for label in labels]
        for index, (left, top, right, bottom) in enumerate(spots):
            for x, y, x_end, y_end in [*boxes, *spots[index + 1 :]]:
                assert right <= x or x_end <= left or bottom <= y or y_end <= top


#: Pixels of the strip's upper lane left of its first scan, 66 px from the left, in the colour of objects.
ORANGE_LEFT = """() => {
  const strip = document.getElementById('strip');
  const ratio = strip.width / strip.clientWidth;
  const { data } = strip.getContext('2d').getImageData(0, 0, Math.floor(65 * ratio), Math.floor(12 * ratio));
  const wanted = getComputedStyle(document.documentElement).getPropertyValue('--object').trim().slice(1);
  const parts = wanted.match(/../g).map((part) => parseInt(part, 16));
  let count = 0;
  for (let i = 0; i < data.length; i += 4) count += parts.every((part, k) => Math.abs(data[i + k] - part) < 12);
  return count;
}"""


def test_the_timeline_is_as_wide_as_the_page(tmp_path: Path, open_page: Open) -> None:
    """Strip and slider reach from padding to padding, and the strip's last mark stands over the slider's end."""
    from tests.mirrorwave.commands.captures.test_view import write_drive

    with test_page.played(write_drive(tmp_path / "drive.mcap")) as server:
        page = open_page(server, "dark", PHONE)
        until(page, "mirrorwave.state.overview && mirrorwave.state.timeline")
        for scheme, width in (("dark", PHONE), ("light", TABLET), ("dark", DESK)):
            resize(page, width, scheme)
            footer, strip, seek = (page.locator(one).bounding_box() for one in ("#timeline", "#strip", "#seek"))
            padding = page.evaluate("parseFloat(getComputedStyle(document.getElementById('timeline')).paddingLeft)")
            assert footer["width"] == pytest.approx(width, abs=0.5)
            assert strip["width"] == pytest.approx(width - 2.0 * padding, abs=0.5)
            assert strip["x"] == pytest.approx(padding, abs=0.5)
            assert seek["x"] + seek["width"] == pytest.approx(strip["x"] + strip["width"], abs=0.5)
            # the names of the lanes have the colour of axes alone: no mark of few, wide scans is drawn over them
            page.evaluate("mirrorwave.state.overview = {times_s: [0, 5, 10], seen: [3, 3, 3], marks: []}")
            page.evaluate("window.dispatchEvent(new Event('resize'))")
            page.locator("#seek").fill("0")
            until(page, "mirrorwave.state.timeline.index === 0")
            assert page.evaluate(ORANGE_LEFT) == 0
            assert page.evaluate(ORANGE_LEFT.replace("65", "200")) > 0
            # buttons stand beneath, none beside it
            for button in page.locator("#timeline button:visible").all():
                assert button.bounding_box()["y"] >= seek["y"] + seek["height"] - 1.0
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert page.evaluate(CUT) == []
        leave(page)


#: Words of warnings that do not lie whole within their box.
CUT_WORDS = """() => [...document.querySelectorAll('.warnings .words *')].filter((one) => {
  const words = one.closest('.words').getBoundingClientRect(), box = one.getBoundingClientRect();
  return box.right > words.right + 1 || box.bottom > one.closest('li').getBoundingClientRect().bottom + 1;
}).map((one) => one.textContent)"""


@pytest.mark.parametrize("width", [DESK, 1600])
def test_the_longest_title_is_whole(open_page: Open, width: int) -> None:
    """A road user that stands and is about to appear: what it is about is the last word of the title."""
    board = Board()
    for scan in range(4):
        left_s = 1.0 - 0.3 * scan if scan < 3 else 0.1
        standing = test_page.road_user(3, 19.4, 13.1, velocity_y_mps=0.3, time_to_appear_s=left_s)
        test_page.board_tracks(board, scan, standing)
    with ViewerServer(board, title="desk") as server:
        page = open_page(server, "light", width)
        until(page, "mirrorwave.state.warnings.some((one) => one.title.endsWith('about to appear'))")
        assert page.locator(".warnings .title", has_text="Slow or standing").count() == 1
        assert page.evaluate(CUT_WORDS) == []
