"""The graph's directory: refused where others may write, made private all the way, no way round by symbolic links."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from msgs.bus.zmq import make_run_dir
from nodes.process.launch_file import launch_from_mapping
from nodes.process.supervisor import LOCK_NAME, Supervisor, read_lock
from nodes.recording.snapshot_trigger import TriggerFile, find_recorders


@pytest.mark.parametrize("mode", [0o770, 0o777, 0o702, 0o1777])
def test_a_directory_that_others_may_write_is_refused_and_left_alone(tmp_path: Path, mode: int) -> None:
    folder = tmp_path / "graph"
    folder.mkdir()
    folder.chmod(mode)
    with pytest.raises(ValueError, match="others may write into it; look what is in it, then chmod 700"):
        make_run_dir(folder)
    assert stat.S_IMODE(folder.stat().st_mode) == mode


def test_a_directory_that_others_may_only_read_is_made_private(tmp_path: Path) -> None:
    folder = tmp_path / "graph"
    folder.mkdir(mode=0o755)
    make_run_dir(folder)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize(("mode", "is_refused"), [(0o770, True), (0o707, True), (0o1777, False), (0o755, False)])
def test_nobody_else_may_rename_it(tmp_path: Path, mode: int, is_refused: bool) -> None:
    parent = tmp_path / "mirrorwave-1000"
    parent.mkdir()
    parent.chmod(mode)
    if is_refused:
        with pytest.raises(ValueError, match=r"others may rename what is in it; chmod go-w, or \+t"):
            make_run_dir(parent / "default")
    else:
        make_run_dir(parent / "default")


def test_what_is_made_on_the_way_is_private_whatever_the_umask(tmp_path: Path) -> None:
    """As /tmp/mirrorwave-1000/default is: a group's umask of 002 must not have it refused the next time."""
    before = os.umask(0o002)
    try:
        make_run_dir(tmp_path / "mirrorwave-1000" / "default")
    finally:
        os.umask(before)
    make_run_dir(tmp_path / "mirrorwave-1000" / "default")
    for folder in (tmp_path / "mirrorwave-1000", tmp_path / "mirrorwave-1000" / "default"):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_the_lock_follows_no_symbolic_link(tmp_path: Path) -> None:
    """Neither to write, which would empty what it leads to, nor to read."""
    precious = tmp_path / "precious"
    precious.write_text('{"pid": 1}')
    make_run_dir(tmp_path / "graph")
    (tmp_path / "graph" / LOCK_NAME).symlink_to(precious)
    launch = launch_from_mapping({"name": "toy", "nodes": {"tick": {"module": "tests.graph.toy_nodes"}}}, "toy.yaml")
    with pytest.raises(ValueError, match=r"supervisor\.lock: must not be a symbolic link"):
        Supervisor(launch, tmp_path / "graph", runs_dir=tmp_path / "runs").run()
    assert read_lock(tmp_path / "graph") == {}
    assert precious.read_text() == '{"pid": 1}'


def test_a_pipe_in_the_lock_s_place_holds_nobody_up(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / LOCK_NAME)
    assert read_lock(tmp_path) == {}


def test_the_recorder_s_door_follows_no_symbolic_link(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    make_run_dir(tmp_path / "graph")
    door = tmp_path / "graph" / f"snapshot-{os.getpid()}.json"
    door.symlink_to(precious)
    with pytest.raises(ValueError, match="must not be a symbolic link"):
        TriggerFile(tmp_path / "graph")
    assert precious.read_text() == "mine"
    # nor is one a recorder
    assert find_recorders(tmp_path / "graph") == []
