"""A node with a topic of its own: how far away the hidden objects of each scan are."""

from typing import Annotated

import msgspec
import numpy as np

from msgs.bus.interface import Outgoing
from msgs.bus.topics import Topic
from msgs.values.arrays import Array, Checked
from nodes.node import Node


class Distances(Checked, frozen=True, kw_only=True):
    """Distances of the hidden objects from the radar, the nearest first."""

    label = "distances"
    stamp_ns: int
    distances_m: Annotated[np.ndarray, Array("<f4", (None,), 0.0, 1e6)]
    nearest_m: float | None = None


TOPICS = (Topic(name="my/distances", type=Distances, rate_hz=1 / 0.3, max_bytes=1 << 16, history_bytes=1 << 20),)


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters that a launch file may set."""

    max_distance_m: float = 100.0


class MyDistances(Node):
    """perception/hidden_objects -> my/distances."""

    inputs = ("perception/hidden_objects",)
    outputs = ("my/distances",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        self._params = params

    def step(self, inputs, now_ns):
        """Answer each view."""
        return [Outgoing("my/distances", self._distances(received.message)) for received in inputs]

    def _distances(self, view):
        all_m = np.sort(np.array([np.hypot(hidden.x_m, hidden.y_m) for hidden in view.objects], np.float32))
        near_m = all_m[all_m <= self._params.max_distance_m]
        nearest_m = float(near_m[0]) if near_m.size else None
        return Distances(stamp_ns=view.stamp_ns, distances_m=near_m, nearest_m=nearest_m)


def create(params: Params) -> MyDistances:
    """Return the node with its parameters."""
    return MyDistances(params)
