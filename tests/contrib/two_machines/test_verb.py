"""The security verbs: keys are made private, and what is open to others is named with what mends it."""

from __future__ import annotations

import json
import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from contrib.two_machines.keys import generate, load_own
from contrib.two_machines.security_checks import (
    Grade,
    Risk,
    check_files,
    check_graph,
    check_keys,
    check_listeners,
    check_node,
    check_run_dir,
    check_user,
    check_zeromq,
)
from mirrorwave.cli import main
from msgs.files.shipped import CHECKOUT
from nodes.process.launch_file import NodeEntry, read_launch_file
from nodes.process.supervisor import LOCK_NAME

OUTSIDE = "tcp://192.0.2.1:7000"
BOUND = "tcp://192.0.2.9:7000"
LAUNCH_DIR = CHECKOUT / "launch"
LAUNCH_FILES = [path for path in sorted(LAUNCH_DIR.glob("*.yaml")) if "\nnodes:" in path.read_text()]


def grades(risks: Any) -> list[Grade]:
    return [risk.status for risk in risks]


def only(risks: Any) -> Risk:
    (risk,) = list(risks)
    assert isinstance(risk, Risk)
    return risk


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    """A run directory as the bus makes it."""
    folder = tmp_path / "domain"
    folder.mkdir(mode=0o700)
    return folder


@pytest.fixture
def keys(tmp_path: Path) -> dict[str, Any]:
    """The parameters of a link with all its keys."""
    _, secret = generate("car", tmp_path / "keys")
    public, _ = generate("desk", tmp_path / "desk")
    allowed = tmp_path / "keys" / "allowed"
    allowed.mkdir(mode=0o700)
    (allowed / "desk.key").write_bytes(public.read_bytes())
    (allowed / "desk.key").chmod(0o644)
    return {"key": str(secret), "allowed": str(allowed)}


def link(**params: Any) -> NodeEntry:
    return NodeEntry(module="contrib.two_machines.link", params=params)


@pytest.fixture(autouse=True)
def own_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory without files of others."""
    folder = tmp_path_factory.mktemp("here")
    monkeypatch.chdir(folder)
    return folder


# files


@pytest.mark.slow
def test_what_a_command_writes_is_its_users_alone(own_folder: Path) -> None:
    """Recording, capture and results: files 0600 and folders 0700 under the usual umask, which stays as it was."""
    before = os.umask(0o022)
    try:
        os.mkdir("out", mode=0o700)
        scene = str(LAUNCH_DIR / "scenes" / "corner.yaml")
        words = ["--chirps-per-beam", "1", "--effects", "basic", "--out", "out/a.mcap"]
        assert main(["sim", "run", scene, *words]) == 0
        assert main(["process", "out/a.mcap", "--out", "results"]) == 0
        assert main(["bag", "convert", "out/a.mcap", "out/b.sigmf-meta"]) == 0
        assert os.umask(0o022) == 0o022
    finally:
        os.umask(before)
    paths = [path for folder in ("out", "results") for path in (own_folder / folder).rglob("*")]
    assert {path.name for path in paths} >= {"a.mcap", "objects.jsonl", "b.sigmf-meta", "b.sigmf-data", "bev.png"}
    assert {stat.S_IMODE(path.stat().st_mode) for path in paths} == {0o600}
    assert stat.S_IMODE((own_folder / "results").stat().st_mode) == 0o700
    assert only(check_files(own_folder)).status is Grade.OK


def test_files_that_others_may_read_are_named_with_what_closes_them(own_folder: Path) -> None:
    for name, mode in {"a.mcap": 0o644, "b.mcap": 0o640, "notes.txt": 0o644, "closed.mcap": 0o600}.items():
        (own_folder / name).touch()
        (own_folder / name).chmod(mode)
    for name, mode in {"open": 0o755, "closed": 0o700}.items():
        (own_folder / "runs" / name).mkdir(parents=True)
        (own_folder / "runs" / name / "log.jsonl").touch()
        (own_folder / "runs" / name / "log.jsonl").chmod(0o644)
        (own_folder / "runs" / name).chmod(mode)
    (own_folder / "runs").chmod(0o755)
    beside, runs = check_files(own_folder)
    assert (beside.status, beside.mend) == (Grade.WARNING, f"chmod go-rwx {own_folder}/*.mcap")
    assert beside.detail == f"others may read 2 files where they get to, e.g. {own_folder}/a.mcap, mode 0644"
    assert (runs.status, runs.mend) == (Grade.WARNING, f"chmod -R go-rwx {own_folder}/runs")
    assert runs.detail == f"others may read 1 file where they get to, e.g. {own_folder}/runs/open/log.jsonl, mode 0644"


# keygen


def test_keygen_makes_a_pair_that_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["security", "keygen", "car", "--out", str(tmp_path / "keys"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    pair = load_own(Path(said["secret"]))
    assert (said["public"], said["public_key"]) == (str(tmp_path / "keys" / "car.key"), pair.public.decode())
    assert pair.secret.decode() not in json.dumps(said)


@pytest.mark.parametrize("name", ["car", "../car"])
def test_keygen_refuses_to_write_over_and_names_that_are_none(tmp_path: Path, name: str) -> None:
    generate("car", tmp_path)
    assert main(["security", "keygen", name, "--out", str(tmp_path)]) == 2


# the command


def test_the_exit_code_is_1_where_something_must_be_mended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MIRRORWAVE_RUN_DIR", str(tmp_path))
    assert main(["security", "check", "--domain", "d", "--json"]) == 0
    risks = json.loads(capsys.readouterr().out)
    assert {tuple(risk) for risk in risks} == {("check", "status", "detail", "mend")}
    (tmp_path / "d").mkdir()
    (tmp_path / "d").chmod(0o755)
    assert main(["security", "check", "--domain", "d"]) == 1
    assert f"chmod 700 {tmp_path / 'd'}" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["missing.yaml"], ["--domain", "../x"]])
def test_wrong_usage_is_2(arguments: list[str]) -> None:
    assert main(["security", "check", *arguments]) == 2


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda path: path.name)
def test_the_launch_files_of_the_project_open_nothing(path: Path) -> None:
    """A link's key files are its user's to make; nothing else of ours may be a problem."""
    for name, entry in read_launch_file(path).nodes.items():
        if entry.module != "contrib.two_machines.link":
            assert Grade.PROBLEM not in grades(check_node(name, entry)), name


# machine


def test_root_is_a_warning_and_a_user_is_well() -> None:
    assert grades(check_user(0)) == [Grade.WARNING]
    assert grades(check_user(1000)) == [Grade.OK]


@pytest.mark.parametrize(
    ("version", "curve", "grade"),
    [((4, 3, 5), True, Grade.OK), ((4, 3, 2), True, Grade.PROBLEM), ((4, 3, 5), False, Grade.PROBLEM)],
)
def test_an_old_library_or_one_that_cannot_encrypt_is_a_problem(
    monkeypatch: pytest.MonkeyPatch, version: tuple[int, int, int], curve: bool, grade: Grade
) -> None:
    import zmq

    monkeypatch.setattr(zmq, "zmq_version_info", lambda: version)
    monkeypatch.setattr(zmq, "has", lambda name: curve)
    assert only(check_zeromq()).status is grade


# run directory


def test_a_run_directory_of_the_bus_is_well(ours: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # the whole path may be too long for a socket address
    monkeypatch.chdir(ours)
    with socket.socket(socket.AF_UNIX) as opened:
        opened.bind("log@a")
        assert only(check_run_dir(ours)).status is Grade.OK
    assert only(check_run_dir(ours.with_name("absent"))).status is Grade.OK


Spoil = Callable[[Path], object]


def _as_link(path: Path) -> None:
    path.symlink_to(path.rename(path.with_name("real")))


@pytest.mark.parametrize(
    ("spoil", "grade", "mend"),
    [
        (lambda path: path.chmod(0o750), Grade.PROBLEM, "chmod 700"),
        (_as_link, Grade.PROBLEM, "rm "),
        (lambda path: path.parent.chmod(0o777), Grade.PROBLEM, "chmod o-w"),
        (lambda path: path.parent.chmod(0o770), Grade.PROBLEM, "chmod g-w"),
        (lambda path: (path / "log@a").symlink_to("/nowhere"), Grade.PROBLEM, "rm "),
        (lambda path: (path / "log@a").touch() or (path / "log@a").chmod(0o666), Grade.WARNING, "chmod go-w"),
    ],
)
def test_an_open_run_directory_is_named_with_what_mends_it(ours: Path, spoil: Spoil, grade: Grade, mend: str) -> None:
    spoil(ours)
    risk = only(check_run_dir(ours))
    assert risk.status is grade
    assert risk.mend.startswith(mend)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files away")
@pytest.mark.parametrize("at", [".", "..", "log@a"])
def test_what_belongs_to_a_stranger_is_a_problem(ours: Path, at: str) -> None:
    (ours / "log@a").touch(mode=0o600)
    os.chown(ours / at, 12345, -1)
    try:
        risk = only(check_run_dir(ours))
    finally:
        os.chown(ours / at, 0, -1)
    assert risk.status is Grade.PROBLEM
    assert "user 12345" in risk.detail


# keys


def test_keys_that_load_are_well_and_others_are_problems(tmp_path: Path, keys: dict[str, Any]) -> None:
    assert grades(check_keys(tmp_path / "keys")) == [Grade.OK, Grade.OK]
    assert grades(check_keys(tmp_path / "absent")) == []
    Path(keys["key"]).chmod(0o644)
    (Path(keys["allowed"]) / "desk.key").unlink()
    own, allowed = check_keys(tmp_path / "keys")
    assert (own.status, own.mend) == (Grade.PROBLEM, f"chmod 600 {keys['key']}")
    assert (allowed.status, "nobody could connect" in allowed.detail) == (Grade.PROBLEM, True)


# launch file


def test_a_node_of_ours_is_well() -> None:
    assert only(check_node("player", NodeEntry(module="nodes.player", params={"scene": "x"}))).status is Grade.OK


@pytest.mark.parametrize(
    ("entry", "grade", "detail"),
    [
        (NodeEntry(module="mine.node"), Grade.WARNING, "mine.node"),
        (NodeEntry(module="nodes.player", env={"LD_PRELOAD": "/tmp/x.so"}), Grade.WARNING, "LD_PRELOAD"),
        (NodeEntry(module="nodes.player", env={"PYTHONPATH": "/tmp"}), Grade.WARNING, "PYTHONPATH"),
        (NodeEntry(module="nodes.player", env={"MIRRORWAVE_RUN_DIR": "/tmp"}), Grade.WARNING, "meeting place"),
        (NodeEntry(module="nodes.player", env={"PYTHONHASHSEED": "0"}), Grade.OK, "nothing beyond"),
        (NodeEntry(module="nodes.player", params={"a": [{"b": OUTSIDE}]}), Grade.PROBLEM, OUTSIDE),
        (NodeEntry(module="nodes.player", params={"a": "tcp://127.0.0.1:1"}), Grade.OK, "nothing beyond"),
        (NodeEntry(module="nodes.can_out", params={"interface": "udp_multicast"}), Grade.WARNING, "CAN frames"),
        (link(bind="tcp://*:7000", export=["log"]), Grade.PROBLEM, "will not start"),
        (link(connect={"a": {"address": OUTSIDE, "topics": ["log"]}}), Grade.PROBLEM, "will not start"),
        (link(bind="tcp://*:7000", export=["log"], insecure=True), Grade.PROBLEM, "tcp://*:7000 is open without keys"),
        (link(connect={"a": {"address": OUTSIDE, "topics": ["log"]}}, insecure=True), Grade.PROBLEM, OUTSIDE),
        (link(bind="tcp://127.0.0.1:7000", export=["log"]), Grade.WARNING, "all users of this machine"),
    ],
)
def test_what_a_launch_file_opens_or_loads_is_named(entry: NodeEntry, grade: Grade, detail: str) -> None:
    first = next(iter(check_node("n", entry)))
    assert (first.status, detail in first.detail) == (grade, True), first
    assert bool(first.mend) is (grade is not Grade.OK)


def test_a_link_with_its_keys_is_well_and_a_missing_one_is_not(tmp_path: Path, keys: dict[str, Any]) -> None:
    peer = {"address": OUTSIDE, "key": str(tmp_path / "desk" / "desk.key"), "topics": ["log"]}
    entry = link(bind="tcp://*:7000", export=["radar/ra_map"], connect={"desk": peer}, **keys)
    risks = list(check_node("link", entry))
    assert set(grades(risks)) == {Grade.OK}
    assert risks[-1].detail == "gives radar/ra_map to peers; takes log from desk"
    for path in (Path(peer["key"]), Path(keys["key"])):
        path.unlink()
    found = [risk for risk in check_node("link", entry) if risk.status is Grade.PROBLEM]
    assert [risk.mend for risk in found] == 2 * ["mirrorwave security keygen NAME"]


def test_insecure_that_is_not_needed_is_a_warning(keys: dict[str, Any]) -> None:
    entry = link(bind="tcp://*:7000", export=["log"], insecure=True, **keys)
    assert next(iter(check_node("link", entry))).detail == "insecure: true is set and not needed"


# running graph


def listener(ip: str, *words: str) -> Any:
    """What is asked of a process, answered without one."""
    opened = SimpleNamespace(laddr=SimpleNamespace(ip=ip, port=7000), status=psutil.CONN_LISTEN)
    spoken = SimpleNamespace(laddr=SimpleNamespace(ip="192.0.2.1", port=7001), status=psutil.CONN_ESTABLISHED)
    return SimpleNamespace(pid=1, cmdline=lambda: list(words), net_connections=lambda kind: [opened, spoken])


def started(**params: Any) -> tuple[str, ...]:
    return ("python", "-m", "nodes.node", "contrib.two_machines.link", "--name", "out", "--params", json.dumps(params))


@pytest.mark.parametrize(
    ("ip", "words", "grade"),
    [
        ("127.0.0.1", (), Grade.OK),
        ("::1", (), Grade.OK),
        ("0.0.0.0", (), Grade.PROBLEM),
        ("::", (), Grade.PROBLEM),
        ("192.0.2.9", started(bind=BOUND, export=["log"], key="a", allowed="b"), Grade.OK),
        ("192.0.2.9", started(bind=BOUND, export=["log"], insecure=True), Grade.PROBLEM),
        ("192.0.2.9", started(bind=BOUND, export=["log"], key="a", allowed="b", other=1), Grade.PROBLEM),
        ("192.0.2.9", ("contrib.two_machines.link", "--params"), Grade.PROBLEM),
        ("192.0.2.9", ("contrib.two_machines.link", "--params", "{"), Grade.PROBLEM),
    ],
)
def test_a_listener_on_the_network_must_be_a_link_with_keys(ip: str, words: tuple[str, ...], grade: Grade) -> None:
    assert only(check_listeners(listener(ip, *words))).status is grade


def test_listeners_of_the_running_graph_are_found(ours: Path) -> None:
    assert only(check_graph(ours)).detail == "none runs in this domain"
    (ours / LOCK_NAME).write_text(json.dumps({"pid": os.getpid()}))
    with socket.create_server(("127.0.0.1", 0)) as opened:
        said = [risk for risk in check_graph(ours) if f"port {opened.getsockname()[1]}" in risk.detail]
        assert grades(said) == [Grade.OK]


def test_what_cannot_be_looked_at_is_said() -> None:
    def refuse(kind: str) -> list[Any]:
        raise psutil.AccessDenied(1)

    process: Any = SimpleNamespace(pid=1, cmdline=list, net_connections=refuse)
    assert only(check_listeners(process)).status is Grade.WARNING
