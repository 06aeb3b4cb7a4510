"""State derived from many messages rather than one: trails, warnings, node table, latency of views, numbers in time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np

from msgs.bus.topics import TOPICS
from msgs.values.diagnostics import NodeStatus
from msgs.values.lidar import LidarSetup
from msgs.values.perception import BevFrame, PathClass, Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.inputs.view_latency import Setup, ViewWatch, on_one_clock, scan_period_s, views_text
from nodes.viewer.driver_warnings import DriverWarning, Facts, NodeFact, Warner
from nodes.viewer.node_table import NodeTable
from nodes.viewer.numeric_fields import MAX_KEY_LENGTH, numeric_fields
from nodes.viewer.series import SeriesStore
from nodes.viewer.trails import Past, Trails

#: Accepted message types; of maps only the time is used.
TOPICS_WATCHED = (
    "perception/hidden_objects",
    "perception/peaks",
    "radar/ra_map",
    "vehicle/state",
    "diagnostics/node",
    "radar/setup",
    "lidar/setup",
)


#: Message types whose numbers are plotted, by the name of their group. Nodes have a group each.
_GROUPS = {
    TOPICS[topic].type: topic
    for topic in ("perception/hidden_objects", "perception/peaks", "radar/ra_map", "vehicle/state")
}


class Watch:
    """Processes messages in order of arrival; belongs to one thread. `start_ns`: when it began to listen.

    The numbers in messages and in the node table go to `series`.
    """

    def __init__(self, start_ns: int, series: SeriesStore) -> None:
        self._series = series
        self._trails = Trails()
        self._views = ViewWatch(start_ns)
        self._nodes = NodeTable()
        self._warner = Warner()
        self._facts = Facts(start_ns, start_ns)
        #: Whether the newest view came after its deadline.
        self.is_late = False
        #: The set-up of the sensor, once received.
        self.sensor: Setup | None = None

    def take(self, message: msgspec.Struct, now_ns: int) -> None:
        """Process one message; topics that are not used here are ignored."""
        group = _GROUPS.get(type(message))
        if group is not None and self._series.is_due(group, now_ns):
            self._series.take(group, _numbers(message, now_ns, self._views.since_ns), now_ns)
        match message:
            case BevFrame():
                self._trails.add_view(message, self._facts.vehicle_from_radar)
                self.is_late = self._views.add(message.scan_id, message.stamp_ns, now_ns)
                self._facts = self._facts._replace(frame=message, frame_at_ns=now_ns)
            case Peaks():
                # the radar's mounting comes with the peaks of each scan
                self._facts = self._facts._replace(vehicle_from_radar=message.vehicle_from_radar)
            case RangeAzimuthMap():
                self._facts = self._facts._replace(map_at_ns=now_ns)
            case VehicleState():
                self._trails.add_state(message)
                self._facts = self._facts._replace(vehicle=message, vehicle_at_ns=now_ns)
            case NodeStatus():
                self._nodes.add(message, now_ns)
                self._views.hear(message, now_ns)
            case RadarSetup() | LidarSetup():
                self._views.set_up(message)
                self.sensor = message
                name = "radar" if isinstance(message, RadarSetup) else "LiDAR"
                self._facts = self._facts._replace(sensor=name, scan_period_s=scan_period_s(message))

    @property
    def since_ns(self) -> int:
        """Since when the graph runs, as far as known: earlier stamps are of what is played back."""
        return self._views.since_ns

    @property
    def past(self) -> tuple[Past, ...]:
        """The scans of the trails, the newest last."""
        return self._trails.past

    def warnings(self, now_ns: int) -> tuple[DriverWarning, ...]:
        """Return the warnings at a time, the most urgent first; to be called often enough for right times."""
        views = self._views.figures(now_ns)
        rows = self._nodes.rows(now_ns)
        nodes = tuple(NodeFact(row["node"], row["state"], row["reason"], row["lost_lately"]) for row in rows)
        graph_since_ns = self._views.since_ns
        return self._warner.step(
            self._facts._replace(now_ns=now_ns, views=views, nodes=nodes, graph_since_ns=graph_since_ns)
        )

    def table(self, now_ns: int) -> dict[str, Any]:
        """Return the node table in the page's form."""
        views, rows = self._views.figures(now_ns), self._nodes.rows(now_ns)
        for row in rows:
            group = f"node {row['node'][:MAX_KEY_LENGTH]}"
            if row["state"] != "silent" and self._series.is_due(group, now_ns):
                self._series.take(group, numeric_fields(row), now_ns)
        graph = {"text": views_text(views), "well": views.misses == views.overdue == 0}
        return {"type": "nodes", "graph": graph, "nodes": rows}


def _numbers(message: msgspec.Struct, now_ns: int, since_ns: int) -> Iterator[tuple[str, float]]:
    """Yield what is plotted of a message: what is counted in it first, then its own numbers."""
    match message:
        case BevFrame():
            if on_one_clock(message.stamp_ns, now_ns, since_ns):
                yield "latency_ms", 1e-6 * (now_ns - message.stamp_ns)
            yield "direct_returns.count", float(len(message.los_points_m))
        case Peaks():
            yield "count", float(len(message.range_m))
            yield "mirrored.count", float(np.count_nonzero(message.path_class == PathClass.MIRRORED))
        case RangeAzimuthMap():
            yield "incoherent_share", float(message.incoherent.mean())
            yield "missing_beams.count", float(len(message.missing_beams))
    yield from numeric_fields(message)
