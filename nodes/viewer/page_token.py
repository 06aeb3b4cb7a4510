"""The page's token across restarts of its node: for one run of a graph, at one port, in a file of its owner alone.

An open page comes back to the node that was restarted only if that node knows the page's token. The file lies in the
graph's directory, which nobody else can enter. What it holds is of no use to another graph, nor at another port: where
the port has gone to another program, that program may have been told the token.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import stat
from pathlib import Path

import msgspec

from msgs.files.whole_files import no_link
from nodes.process.supervisor import read_lock

_LOG = logging.getLogger(__name__)
_MAX_BYTES = 4096
_TOKEN = re.compile(r"[A-Za-z0-9_-]{32,128}")


class KeptToken(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A token, the run of the graph and the port that it is good for."""

    #: The supervisor's process, when it started in clock ticks since boot, and the folder of its run.
    graph: tuple[int, int, str]
    port: int
    token: str


class TokenFile:
    """Where a viewer keeps its token; in a directory where no supervised graph runs it keeps none."""

    def __init__(self, path: Path) -> None:
        self._path = path
        owner = read_lock(path.parent)
        is_known = {"pid", "started", "run"} <= owner.keys()
        self._graph = (owner["pid"], owner["started"], owner["run"]) if is_known else None

    def recall(self) -> KeptToken | None:
        """Return the token that an earlier process of this node kept during this run of the graph."""
        if self._graph is None:
            return None
        try:
            kept = msgspec.json.decode(_read(self._path), type=KeptToken)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            # neither the file's bytes nor msgspec's quotes: they may be a token
            _LOG.warning("%s: not used, a new token is drawn: %s", self._path, type(error).__name__)
            return None
        is_good = kept.graph == self._graph and _TOKEN.fullmatch(kept.token) and 0 < kept.port <= 65535
        return kept if is_good else None

    def keep(self, port: int, token: str) -> None:
        """Write a token down; where that fails the next process draws another, and the open page says so."""
        if self._graph is None:
            return
        kept = KeptToken(graph=self._graph, port=port, token=token)
        written = self._path.with_name(f"{self._path.name}.{os.getpid()}")
        try:
            with contextlib.suppress(FileNotFoundError):
                written.unlink()
            descriptor = os.open(written, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(msgspec.json.encode(kept))
            written.replace(self._path)
        except OSError as error:
            _LOG.warning("%s: the page will not come back after a restart: %s", self._path, error.strerror)


def _read(path: Path) -> bytes:
    """Return bytes of a regular file of ours that nobody else can read; raises `ValueError` for any other."""
    with open(path, "rb", opener=no_link) as file:
        found = os.fstat(file.fileno())
        if not stat.S_ISREG(found.st_mode) or found.st_uid != os.geteuid() or found.st_mode & 0o077:
            raise ValueError("must be a regular file of ours, mode 0600")
        return file.read(_MAX_BYTES + 1)
