"""Limit of open files: raised as far as it may be, and named where it is too low."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import zmq

from mirrorwave.console import error_line
from msgs.files.open_files import MIN_OPEN_FILES, open_files_line, raise_open_files
from msgs.files.shipped import CHECKOUT
from nodes.node import one_line


@pytest.mark.parametrize("line", [error_line, one_line])
@pytest.mark.parametrize(
    "error", [OSError(errno.EMFILE, os.strerror(errno.EMFILE), "/a/b"), zmq.ZMQError(errno.EMFILE)]
)
def test_a_process_that_can_open_no_more_says_how_to_raise_the_limit(
    line: Callable[[Exception], str], error: Exception
) -> None:
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    text = line(error)
    assert text.startswith(f"too many open files: the limit is {limit} a process; `ulimit -n 1024`")
    assert open_files_line(OSError(errno.ENOENT, "no such file")) == ""


@pytest.mark.parametrize(
    ("words", "said_by"),
    [
        (("mirrorwave", "launch", "launch/corner_view.yaml", "--runs-dir"), "mirrorwave: "),
        (("nodes.node", "nodes.bev_viewer", "--name", "viewer", "--run-dir"), ""),
    ],
    ids=["graph", "node"],
)
def test_a_limit_that_is_too_low_is_one_line(words: tuple[str, ...], said_by: str, tmp_path: Path) -> None:
    ended = subprocess.run(
        [sys.executable, "-m", *words, str(tmp_path)],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40)),
    )
    assert ended.returncode == 1
    assert ended.stderr.startswith(f"{said_by}too many open files: the limit is 40 a process, a graph needs 128; ")
    assert ended.stderr.count("\n") == 1


def test_a_low_limit_is_raised_where_it_may_be() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (MIN_OPEN_FILES, before[1]))
        limit = raise_open_files()
        assert limit == resource.getrlimit(resource.RLIMIT_NOFILE)[0] > MIN_OPEN_FILES
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
