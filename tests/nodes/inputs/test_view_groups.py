"""Views of several radars in groups: none waits for a silent radar, clocks may differ, what is late is counted."""

from __future__ import annotations

import msgspec
import pytest

from models.perception.track.view_fusion import RadarView
from msgs.values.frames import Pose2
from nodes.inputs.view_groups import SILENT_NS, WAIT_NS, ViewGroups
from tests.builders import example_view

PERIOD_NS, LAG_NS, SECOND_NS = 300_000_000, 350_000_000, 1_000_000_000


def view(stamp_ns: int) -> RadarView:
    """An empty view."""
    return RadarView(example_view(stamp_ns=stamp_ns), Pose2())


def play(groups: ViewGroups, name: str, scan: int, late_ns: int = 0, clock_ns: int = 0) -> int:
    """Add the view of a scan of a radar whose clock is ahead; return when it came."""
    now_ns = scan * PERIOD_NS + LAG_NS + late_ns
    groups.add(name, view(scan * PERIOD_NS + clock_ns), now_ns, now_ns)
    return now_ns


def test_a_group_holds_the_next_view_of_each() -> None:
    """The first view waits for the second, which may come 0.1 s later."""
    groups = ViewGroups(("left", "right"))
    for scan in range(3):
        now_ns = play(groups, "right", scan)
        assert groups.take(now_ns) is None
        now_ns = play(groups, "left", scan, 100_000_000)
        group = groups.take(now_ns)
        assert group is not None
        assert [item.frame.stamp_ns for item in group[0]] == [scan * PERIOD_NS] * 2
        assert group[1]
        assert groups.take(now_ns) is None
        assert groups.due_ns(now_ns) is None
    assert groups.trouble(now_ns) == ""
    assert groups.left_out == 0


def test_a_silent_radar_is_not_waited_for() -> None:
    """Its last view is followed by groups that wait for it, then by groups that do not and say that it is missing."""
    groups = ViewGroups(("left", "right"))
    play(groups, "left", 0)
    assert groups.take(play(groups, "right", 0)) is not None
    for scan in range(1, 8):
        now_ns = play(groups, "right", scan)
        is_lost = now_ns - LAG_NS > SILENT_NS
        group = groups.take(now_ns) or groups.take(now_ns + WAIT_NS)
        assert group is not None
        assert (groups.due_ns(now_ns), group[1]) == (None, not is_lost and group[1])
        assert len(group[0]) == 1
    assert groups.trouble(now_ns) == "radar left is silent: the view is that of the others"
    play(groups, "left", 8)
    group = groups.take(play(groups, "right", 8))
    assert group is not None
    assert group[1]
    assert groups.trouble(8 * PERIOD_NS + LAG_NS) == ""


def test_a_radar_that_never_speaks_is_named() -> None:
    """The others go on without it."""
    groups = ViewGroups(("left", "right"))
    for scan in range(6):
        now_ns = play(groups, "right", scan)
        group = groups.take(now_ns) or groups.take(now_ns + WAIT_NS)
        assert group is not None
    assert not group[1]
    assert groups.trouble(now_ns).startswith("radar left is silent")


@pytest.mark.parametrize("ahead_s", [1.0, -1.0, 3600.0])
@pytest.mark.parametrize("wrong", ["left", "right"])
def test_clocks_that_differ_are_named_and_nothing_is_lost(ahead_s: float, wrong: str) -> None:
    """Views of the wrong clock, as the vehicle's states show, are taken by their arrival: every group is whole, and its
    stamp is that of the right clock.
    """
    groups = ViewGroups(("left", "right"))
    for scan in range(4):
        groups.hear_state(scan * PERIOD_NS, scan * PERIOD_NS + 2_000_000)
        clock_ns = round(ahead_s * SECOND_NS)
        for name in ("left", "right"):
            now_ns = play(groups, name, scan, clock_ns=clock_ns if name == wrong else 0)
        group = groups.take(now_ns)
        assert group is not None
        assert group[1]
        assert {item.frame.stamp_ns for item in group[0]} == {scan * PERIOD_NS}
    where = "ahead of" if ahead_s > 0.0 else "behind"
    trouble = f"radar {wrong}: its clock is {abs(ahead_s):.1f} s {where} that of the others"
    assert groups.trouble(now_ns) == f"{trouble}, its views are taken by their arrival"
    assert groups.left_out == 0


def test_a_busy_machine_is_no_clock() -> None:
    """A first view of the left radar that takes 0.8 s longer than any other delays its group; no later one is moved or
    left out.
    """
    groups = ViewGroups(("left", "right"))
    groups.hear_state(0, 2_000_000)
    play(groups, "right", 0)
    now_ns = play(groups, "left", 0, 800_000_000)
    assert groups.take(now_ns) is not None
    for scan in range(3, 9):
        play(groups, "right", scan)
        group = groups.take(play(groups, "left", scan, 50_000_000))
        assert group is not None
        assert [item.frame.stamp_ns for item in group[0]] == [scan * PERIOD_NS] * 2
    assert (groups.left_out, groups.trouble(9 * PERIOD_NS)) == (0, "")


def test_a_clock_that_is_set_back_is_named_after_some_scans() -> None:
    """A clock of the right radar that is set back by a second in the middle of a drive."""
    groups = ViewGroups(("left", "right"))
    for scan in range(20):
        groups.hear_state(scan * PERIOD_NS, scan * PERIOD_NS + 2_000_000)
        play(groups, "left", scan)
        group = groups.take(play(groups, "right", scan, clock_ns=-SECOND_NS if scan > 5 else 0))
        assert group is not None
        assert max(item.frame.stamp_ns for item in group[0]) == scan * PERIOD_NS
    assert {item.frame.stamp_ns for item in group[0]} == {19 * PERIOD_NS}
    assert "radar right: its clock is 1.0 s behind" in groups.trouble(20 * PERIOD_NS)
    assert groups.left_out == 0


def test_objects_are_moved_with_the_clock_of_their_radar() -> None:
    """Those without a time of their own have none afterwards."""
    from tests.models.perception.track.test_view_fusion import hidden

    groups = ViewGroups(("left", "right"))
    objects = (hidden(1.0, 2.0, stamp_ns=SECOND_NS + 50), hidden(1.0, 2.0))
    late = view(SECOND_NS)
    groups.hear_state(0, 0)
    groups.add("left", late._replace(frame=msgspec.structs.replace(late.frame, objects=objects)), LAG_NS, LAG_NS)
    play(groups, "right", 0)
    group = groups.take(LAG_NS)
    assert group is not None
    assert [item.stamp_ns for item in group[0][0].frame.objects] == [50, 0]


def test_a_view_after_its_group_is_counted() -> None:
    """A late view is left out; of a radar that sends two while the other sends one the newer is taken."""
    groups = ViewGroups(("left", "right"))
    assert groups.take(play(groups, "right", 1) + WAIT_NS) is not None
    now_ns = play(groups, "left", 1, WAIT_NS + 1)
    assert groups.take(now_ns) is None
    assert groups.take(now_ns + WAIT_NS) is None
    assert groups.left_out == 1
    for scan in (2, 3):
        play(groups, "right", scan)
    group = groups.take(play(groups, "left", 3))
    assert group is not None
    assert [item.frame.stamp_ns for item in group[0]] == [3 * PERIOD_NS] * 2
    assert groups.left_out == 2
