"""A node with a compiled kernel, which says when it is made whether its process holds the compiler."""

from __future__ import annotations

import os

from numba.core.registry import cpu_target

from models.compiled import compiled
from tests.graph.toy_nodes import Echo, Params

__all__ = ["Params", "create"]


@compiled
def doubled(value):  # type: ignore[no-untyped-def]
    """Return twice a number."""
    return 2.0 * value


def create(params: Params) -> Echo:
    node = Echo(params)
    node.total = doubled(node.total)
    os.write(1, b"made with the compiler\n" if cpu_target.typing_context._functions else b"made from the cache\n")
    return node
