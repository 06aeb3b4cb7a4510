"""Limit of the files that a process may have open at once."""

from __future__ import annotations

import errno
import os
import resource

#: Below this no graph is started: its processes would end one by one. libzmq ends a process that can open no more.
MIN_OPEN_FILES = 128
#: More than any part of the graph opens.
WANTED_OPEN_FILES = 4096


def raise_open_files() -> int:
    """Raise the limit of this process, and of those that it starts, as far as permitted and needed; return it."""
    soft, hard = (_count(limit) for limit in resource.getrlimit(resource.RLIMIT_NOFILE))
    wanted = min(hard, WANTED_OPEN_FILES)
    if soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    return min(max(soft, wanted), WANTED_OPEN_FILES)


def require_open_files() -> None:
    """Raise the limit; `OSError` where it stays too low for a graph."""
    if raise_open_files() < MIN_OPEN_FILES:
        raise OSError(errno.EMFILE, f"a graph needs {MIN_OPEN_FILES}")


def open_files_line(error: BaseException) -> str:
    """Return why a process can open no more files and how to raise the limit; empty for any other error."""
    if getattr(error, "errno", None) != errno.EMFILE:
        return ""
    limit = _count(resource.getrlimit(resource.RLIMIT_NOFILE)[0])
    reason = error.strerror if isinstance(error, OSError) else ""
    needed = "" if reason in (None, "", os.strerror(errno.EMFILE)) else f", {reason}"
    mend = "`ulimit -n 1024` in the shell or LimitNOFILE= of the service raises it"
    return f"too many open files: the limit is {limit} a process{needed}; {mend}"


def _count(limit: int) -> int:
    return WANTED_OPEN_FILES if limit == resource.RLIM_INFINITY else limit
