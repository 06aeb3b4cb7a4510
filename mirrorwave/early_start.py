"""The fork server of a graph, which loads its libraries while the command line is still being read.

Loaded before all else, for every verb, so it imports what starts a server where one is wanted.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nodes.process.fork_server import ForkServer

#: Verbs that run a graph.
_VERBS = ("launch", "demo")
_server: ForkServer | None = None


def begin(words: Sequence[str]) -> None:
    """Start the fork server where the words of a command line are those of a graph.

    It ends with this process, whatever becomes of the command.
    """
    global _server
    if (
        not words
        or words[0] not in _VERBS
        or {"-h", "--help", "help"} & set(words)
        or "_MIRRORWAVE_COMPLETE" in os.environ
    ):
        return
    from nodes.process.fork_server import ForkServer
    from nodes.process.kernel_cache import use_fallback

    try:
        use_fallback()
        _server = ForkServer()
    except (OSError, ValueError):
        # said by the verb, which tries again
        _server = None


def take() -> ForkServer | None:
    """Return the fork server that was started, once: who takes it closes it."""
    global _server
    taken, _server = _server, None
    return taken
