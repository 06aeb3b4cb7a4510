"""Objects of a list of detections: what the network is sure of, and what it and the folded returns see alike.

The network's map has the beams of the radar that it was trained for, the list's returns are finer: an object of many
returns that fold to one place needs less of the network, and where that sees nothing at all there is none.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from msgs.values.perception import HiddenObject

#: Least probability of an object that the network alone sees, and of one that folded returns see too: chosen on 60
#: drawn places (seed 48001) and on real streets.
SURE_THRESHOLD, WITNESS_THRESHOLD = 0.65, 0.1
#: Reports nearer than this are of one object.
SAME_M = 2.0


def agreed(judged: Sequence[HiddenObject], folded: Sequence[HiddenObject]) -> tuple[HiddenObject, ...]:
    """Return the objects of a list, best first: the network's, `judged`, and of the less likely ones those that lie
    at a cluster of `folded` returns, with its score if that is higher.
    """
    objects = []
    for item in judged:
        scores = [other.score for other in folded if np.hypot(other.x_m - item.x_m, other.y_m - item.y_m) < SAME_M]
        if item.score >= SURE_THRESHOLD or scores:
            objects.append(msgspec.structs.replace(item, score=max(item.score, *scores)) if scores else item)
    objects.sort(key=lambda item: -item.score)
    return tuple(msgspec.structs.replace(item, id=index) for index, item in enumerate(objects))
