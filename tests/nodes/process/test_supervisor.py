"""Decisions of the supervisor without a process: when a node is looked at, restarted, given up, begun and stopped."""

from __future__ import annotations

import os
import signal
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from nodes.process import supervisor
from nodes.process.launch_file import launch_from_mapping
from nodes.process.liveness import LATE_S, Sample, Silence
from nodes.process.supervisor import DRAIN_S, PATIENCE_S, Phase, Supervisor, _new_run_folder, read_lock

HEARD_S = 1000.0


class _Child:
    """A process that is asked to stop."""

    pid = 1
    ended = -1

    def __init__(self) -> None:
        self.patience_s: list[float] = []
        self.begun = self.killed = 0

    def stop(self, now_s: float, patience_s: float, last_s: float) -> None:
        self.patience_s.append(patience_s)

    def begin(self) -> None:
        self.begun += 1

    def kill(self) -> None:
        self.killed += 1

    def close(self) -> list[str]:
        return []


@pytest.mark.parametrize(("silent_s", "is_late"), [(0.9 * LATE_S, False), (2.0 * LATE_S, True)])
def test_a_node_that_waits_for_input_between_heartbeats_gets_all_its_time_to_stop(
    silent_s: float, is_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All its threads sleep, as a node's do that waits for a scan. Only a late heartbeat makes that a block, and one
    that is blocked gets half a second.
    """
    now_s = HEARD_S
    monkeypatch.setattr(supervisor, "sample", lambda pid: Sample(now_s, "SS", 1.0, 0.0))
    entry = launch_from_mapping({"name": "one", "nodes": {"one": {"module": "nodes.geometry"}}}, "one.yaml").nodes[
        "one"
    ]
    node, child = supervisor._Watched(entry), _Child()
    node.child, node.phase = child, Phase.READY  # type: ignore[assignment]
    node.heard(HEARD_S)
    for step in range(1, 21):
        now_s = HEARD_S + silent_s * step / 20
        assert node.look(now_s) == ""
    now_s += 0.01
    node.stop(now_s, DRAIN_S, by_hand=False)
    assert child.patience_s == [0.5 if is_late else DRAIN_S]


def test_restarts_are_forgotten_a_window_later() -> None:
    """Restarts at 0, 10 and 65 s in a window of 60 s: at 65 s the first is past, at 70 s the second too."""
    text = {"module": "nodes.geometry", "restart": {"window_s": 60.0}}
    node = supervisor._Watched(launch_from_mapping({"name": "one", "nodes": {"one": text}}, "one.yaml").nodes["one"])
    counted = []
    for now_s in (0.0, 10.0, 65.0):
        node.restarts.append(now_s)
        counted.append(node.recent_restarts(now_s))
    assert (counted, node.recent_restarts(70.0), node.recent_restarts(125.1)) == ([1, 2, 2], 1, 0)


def graph(**nodes: dict[str, Any]) -> Supervisor:
    """A supervisor of some nodes whose bus and log are not there; what it says is kept as (level, text)."""
    entries = {name: {"module": "nodes.geometry", **entry} for name, entry in nodes.items()}
    made = Supervisor(launch_from_mapping({"name": "one", "nodes": entries}, "one.yaml"), Path("/nowhere"))
    made._bus = SimpleNamespace(unwatch=lambda source: None, watch=lambda source: None)  # type: ignore[assignment]
    made._restarts = SimpleNamespace(current=None, end=lambda reason: None)  # type: ignore[assignment]
    made.said = []  # type: ignore[attr-defined]
    made._say = lambda level, text: made.said.append((level, text))  # type: ignore[attr-defined, method-assign]
    for node in made._nodes.values():
        node.child, node.phase, node.was_ready = _Child(), Phase.READY, True  # type: ignore[assignment]
    return made


def ended(made: Supervisor, name: str, code: int, now_s: float = HEARD_S) -> Any:
    """A node after its process has ended."""
    node = made._nodes[name]
    node.child, node.silence, node.is_said = _Child(), Silence(), True
    made._let_go(name, node)
    # what was said of its silence is past
    assert (node.child, node.silence, node.is_said) == (None, None, False)
    made._after_exit(name, node, code, now_s)
    return node


@pytest.mark.parametrize(
    ("policy", "code", "phase", "exit_code"),
    [
        ("on-failure", 1, Phase.WAITING, 0),
        ("on-failure", -9, Phase.WAITING, 0),
        ("on-failure", 0, Phase.ENDED, 0),
        ("always", 0, Phase.WAITING, 0),
        ("always", 1, Phase.WAITING, 0),
        ("never", 0, Phase.ENDED, 0),
        ("never", 1, Phase.FAILED, 1),
        # parameters that it refuses it refuses again
        ("always", 2, Phase.FAILED, 2),
        ("on-failure", 2, Phase.FAILED, 2),
    ],
)
def test_an_ended_node_is_restarted_by_its_policy(policy: str, code: int, phase: Phase, exit_code: int) -> None:
    made = graph(a={"restart": {"policy": policy}}, b={})
    assert (ended(made, "a", code).phase, made._exit_code) == (phase, exit_code)
    # it had been ready: the others go on without it
    assert made._stopping is None


def test_restarts_wait_longer_and_end_after_so_many_in_the_window() -> None:
    """At once, then 0.2 and 0.4 s later; the fourth within a minute is too many, 60 s after the first it is not."""
    waits, made = [], graph(a={"restart": {"max_restarts": 3}}, b={})
    for now_s in (0.0, 10.0, 20.0):
        waits.append(ended(made, "a", 1, now_s).start_at_s - now_s)
    assert waits == pytest.approx([0.0, 0.2, 0.4])
    later = ended(made, "a", 1, 60.0)
    assert (later.phase, later.start_at_s) == (Phase.WAITING, pytest.approx(60.4))
    assert ended(made, "a", -signal.SIGSEGV, 69.9).phase is Phase.FAILED
    assert ("error", "a was ended by SIGSEGV; 3 restarts in 60 s") in made.said  # type: ignore[attr-defined]
    assert made._exit_code == 1


def test_a_closed_terminal_is_written_to_once_and_the_log_goes_on() -> None:
    made, written, shown = graph(a={}), list[Any](), list[Any]()

    def show(entry: Any) -> None:
        shown.append(entry)
        raise BrokenPipeError

    made._log, made._on_log = SimpleNamespace(write=written.append), show  # type: ignore[assignment]
    for text in ("first", "second"):
        made._write({"text": text})
    assert ([entry["text"] for entry in written], len(shown)) == (["first", "second"], 1)


def test_a_restart_on_request_has_the_new_parameters_and_waits_for_nothing() -> None:
    made = graph(a={}, b={})
    for now_s in (0.0, 10.0):
        assert ended(made, "a", 1, now_s).start_at_s >= now_s
    entry = msgspec.structs.replace(made._launch.nodes["a"], params={"new": 1})
    made._start_again(SimpleNamespace(node="a", entry=entry, has_ended=False))  # type: ignore[arg-type]
    node = made._nodes["a"]
    assert (node.phase, node.start_at_s, node.entry.params) == (Phase.WAITING, 0.0, {"new": 1})


def test_a_node_that_was_never_ready_or_ends_the_graph_stops_all() -> None:
    made = graph(a={"restart": {"policy": "never"}}, b={})
    made._nodes["a"].was_ready = False
    ended(made, "a", 1)
    assert made._stopping is not None
    made = graph(player={"ends_graph": True}, b={"after": ["player"]}, c={"after": ["b"]})
    ended(made, "player", 0)
    # sources first, so that each can answer what waits
    assert [group[0] for group in made._stopping or []] == ["c", "b", "player"]


def test_the_first_refused_parameter_decides_the_exit_code() -> None:
    made = graph(a={"restart": {"policy": "never"}}, b={"restart": {"policy": "never"}}, c={})
    ended(made, "a", 1)
    assert made._exit_code == 1
    ended(made, "b", 2)
    assert made._exit_code == 2


def test_a_node_begins_after_those_it_names_and_a_recorder_gets_ready_first() -> None:
    made = graph(recorder={"module": "nodes.recorder"}, a={"after": ["recorder"]}, b={"after": ["a"]})
    recorder, a, b = made._nodes.values()
    recorder.was_ready = a.was_ready = False
    assert [made._may_start(node) for node in (recorder, a, b)] == [True, False, True]
    assert [made._may_begin(node) for node in (recorder, a, b)] == [True, False, False]
    recorder.was_ready = True
    assert [made._may_begin(node) for node in (recorder, a, b)] == [True, True, False]
    # one that has ended is waited for no more
    a.phase = Phase.ENDED
    assert made._may_begin(b)


def test_the_duration_counts_from_when_all_were_ready_and_one_shots_end_the_graph() -> None:
    made = graph(a={}, b={"restart": {"policy": "never"}}, c={"restart": {"policy": "never"}})
    a, b, c = made._nodes.values()
    made._duration_s, a.was_ready = 10.0, False
    assert not made._duration_over(1000.0)
    a.was_ready = True
    assert [made._duration_over(now_s) for now_s in (100.0, 109.9, 110.0)] == [False, False, True]
    b.phase = Phase.ENDED
    assert not made._one_shots_ended()
    c.phase = Phase.ENDED
    assert made._one_shots_ended()
    assert not graph(a={})._one_shots_ended()


def test_a_stop_by_hand_asks_all_at_once_and_one_in_order_the_next() -> None:
    """In order each gets the time to answer its inputs; by hand less, all together; a third request kills."""
    made = graph(a={}, b={"after": ["a"]})
    children = {name: node.child for name, node in made._nodes.items()}
    for node in made._nodes.values():
        node.heard(HEARD_S)
    made._stop_in_order("test")
    made._start_or_stop(HEARD_S)
    asked = {name: child.patience_s for name, child in children.items()}  # type: ignore[union-attr]
    assert sorted(asked.values()) == [[], [DRAIN_S]]
    made.request_stop()
    made._check_end(HEARD_S)
    made._start_or_stop(HEARD_S)
    assert {patience_s[-1] for patience_s in asked.values()} == {PATIENCE_S}
    assert not made._all_gone()
    for killed in (0, 1):
        made.request_stop()
        made._check_end(HEARD_S)
        assert [child.killed for child in children.values()] == [killed, killed]  # type: ignore[union-attr]
    for name in children:
        ended(made, name, -signal.SIGKILL)
    assert made._all_gone()
    assert [text for level, text in made.said if level == "warning"][1:] == [  # type: ignore[attr-defined]
        f"{name} did not stop when asked and was killed" for name in ("a", "b")
    ]


@pytest.mark.parametrize(("duration_s", "rule"), [(None, ""), (0.1, ""), (0.0, "above zero"), (float("nan"), "above")])
def test_a_duration_is_above_zero(duration_s: float | None, rule: str) -> None:
    launch = launch_from_mapping({"name": "one", "nodes": {"a": {"module": "nodes.geometry"}}}, "one.yaml")
    with pytest.raises(ValueError, match=rule) if rule else nullcontext():
        Supervisor(launch, Path("/nowhere"), duration_s=duration_s)


def test_a_run_has_a_folder_of_its_own_that_others_cannot_read(tmp_path: Path) -> None:
    launch = launch_from_mapping({"name": "one", "nodes": {"a": {"module": "nodes.geometry"}}}, "one.yaml")
    folders = [_new_run_folder(tmp_path / "runs", launch) for _ in range(2)]
    assert [folder.name for folder in folders] == ["one-1", "one-2"]
    assert [folder.stat().st_mode & 0o777 for folder in folders] == [0o700, 0o700]


@pytest.mark.parametrize(
    ("text", "pid"),
    [
        (f'{{"pid": {os.getpid()}}}', os.getpid()),
        # the number of a process that has ended may be another's by now
        (f'{{"pid": {os.getpid()}, "started": 1}}', None),
        ('{"pid": 4194999}', None),
        ("[]", None),
        ("", None),
        ("{", None),
    ],
    # workers must collect the same names
    ids=("own", "reused", "ended", "list", "empty", "cut"),
)
def test_the_lock_says_whose_graph_runs(tmp_path: Path, text: str, pid: int | None) -> None:
    (tmp_path / supervisor.LOCK_NAME).write_text(text)
    assert read_lock(tmp_path).get("pid") == pid
    assert read_lock(tmp_path / "none") == {}
