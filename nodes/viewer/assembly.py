"""Puts what belongs to one scan together and posts it: view with truth and vehicle, map with its peaks, node table."""

from __future__ import annotations

from functools import partial
from typing import Any

import msgspec

from msgs.diagnostics import NodeStatus
from msgs.perception import BevFrame, Peaks, SceneTruth
from msgs.radar import RadarSetup, RangeAzimuthMap
from msgs.units import NANOSECONDS_PER_SECOND
from msgs.vehicle import VehicleState
from nodes.live_timing import ViewWatch, on_one_clock, views_text
from nodes.viewer.board import Board, WireMessage, json_text
from nodes.viewer.node_table import NodeTable
from nodes.viewer.view_model import map_json, map_tile, mask_tile, view_json

#: What the assembly takes in.
TOPICS_SHOWN = (
    "perception/hidden_objects",
    "radar/ra_map",
    "perception/peaks",
    "sim/truth",
    "vehicle/state",
    "diagnostics/node",
    "radar/setup",
)
#: The node table is posted this often.
TABLE_PERIOD_NS = NANOSECONDS_PER_SECOND // 2
#: Truth and view of a scan come within this many scans of each other.
_KEPT_TRUTHS = 8
#: While views miss their deadline, pictures of maps are posted no oftener than this: the first work to be shed.
LATE_MAP_PERIOD_NS = 2 * NANOSECONDS_PER_SECOND


class Assembly:
    """Takes messages in order of arrival and posts newest-only on a board. Belongs to one thread.

    With `gives_way` it leaves out most pictures of maps while views come late; `maps_shed` counts them.
    """

    def __init__(self, board: Board, gives_way: bool = False) -> None:
        self._board = board
        self._gives_way = gives_way
        self.maps_shed = 0
        self._map_posted_ns: int | None = None
        self._is_late = False
        self._watch: ViewWatch | None = None
        self._frame: BevFrame | None = None
        #: Views so far: a page that misses some can tell how many, however often each was posted.
        self._number = 0
        self._latency_ms: float | None = None
        #: Waits for the view of its scan, so that both change together.
        self._map: tuple[RangeAzimuthMap, float | None] | None = None
        self._peaks: Peaks | None = None
        self._truths: dict[int, SceneTruth] = {}
        self._vehicle: VehicleState | None = None
        self._nodes = NodeTable()
        self._table_due_ns: int | None = None

    def take(self, message: msgspec.Struct, now_ns: int) -> None:
        """Take in one message of `TOPICS_SHOWN`; post what it completes."""
        match message:
            case RadarSetup():
                self._views(now_ns).set_up(message)
            case BevFrame():
                self._number += 1
                self._frame, self._latency_ms = message, _age_ms(message.stamp_ns, now_ns)
                self._is_late = self._views(now_ns).add(message.scan_id, message.stamp_ns, now_ns)
                self._post_view()
                self._post_map(now_ns)
            case RangeAzimuthMap():
                # no view came for the map before: better shown alone than not at all
                self._post_map(now_ns)
                self._map = message, _age_ms(message.stamp_ns, now_ns)
            case Peaks():
                self._peaks = message
            case SceneTruth():
                self._keep_truth(message)
            case VehicleState():
                self._vehicle = message
            case NodeStatus():
                self._nodes.add(message, now_ns)

    def table_due_ns(self, now_ns: int) -> int:
        """When the node table is to be posted next."""
        if self._table_due_ns is None:
            self._table_due_ns = now_ns
        return self._table_due_ns

    def post_table(self, now_ns: int) -> None:
        """Post the node table as it stands."""
        self._table_due_ns = now_ns + TABLE_PERIOD_NS
        views = self._views(now_ns).figures(now_ns)
        graph = {"text": views_text(views), "well": views.misses == views.overdue == 0}
        table = {"type": "nodes", "graph": graph, "nodes": self._nodes.rows(now_ns)}
        self._board.post("nodes", lambda: (json_text(table),))

    def _views(self, now_ns: int) -> ViewWatch:
        self._watch = self._watch or ViewWatch(now_ns)
        return self._watch

    def _post_view(self) -> None:
        assert self._frame is not None
        truth = self._truths.get(self._frame.scan_id)
        facts = {"number": self._number, "latency_ms": self._latency_ms}
        self._board.post("view", partial(_view_messages, self._frame, truth, self._vehicle, facts))

    def _post_map(self, now_ns: int) -> None:
        if self._map is None:
            return
        if self._is_map_shed(now_ns):
            self.maps_shed += 1
        else:
            self._board.post("map", partial(_map_messages, *self._map, self._peaks))
            self._map_posted_ns = now_ns
        self._map = None

    def _is_map_shed(self, now_ns: int) -> bool:
        if not (self._gives_way and self._is_late) or self._map_posted_ns is None:
            return False
        return now_ns - self._map_posted_ns < LATE_MAP_PERIOD_NS

    def _keep_truth(self, truth: SceneTruth) -> None:
        self._truths.pop(truth.scan_id, None)
        self._truths[truth.scan_id] = truth
        while len(self._truths) > _KEPT_TRUTHS:
            del self._truths[next(iter(self._truths))]
        if self._frame is not None and self._frame.scan_id == truth.scan_id:
            self._post_view()


def _view_messages(
    frame: BevFrame, truth: SceneTruth | None, vehicle: VehicleState | None, facts: dict[str, Any]
) -> tuple[WireMessage, ...]:
    return json_text({**view_json(frame, truth, vehicle), **facts}), mask_tile(frame)


def _map_messages(ra_map: RangeAzimuthMap, latency_ms: float | None, peaks: Peaks | None) -> tuple[WireMessage, ...]:
    return json_text({**map_json(ra_map, peaks), "latency_ms": latency_ms}), map_tile(ra_map)


def _age_ms(stamp_ns: int, now_ns: int) -> float | None:
    """Time since the first beam, None where stamp and clock have nothing to do with each other."""
    return round(1e-6 * (now_ns - stamp_ns), 1) if on_one_clock(stamp_ns, now_ns) else None
