"""The command line: exit codes, one-line errors, JSON, and every verb on recordings and quiet domains."""

from __future__ import annotations

import importlib.util
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer import Context
from typer.core import TyperGroup
from typer.main import get_command

from mirrorwave import cli
from mirrorwave.cli import command_line, main
from mirrorwave.completion import complete_nodes
from mirrorwave.console import error_line, exit_code_of
from msgs.files.shipped import LAUNCH
from msgs.recording.mcap import RecordingWriter, info
from msgs.values.vehicle import VehicleState

pytestmark = pytest.mark.usefixtures("quiet_domain")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, {}) as writer:
        for index in range(10):
            state = VehicleState(stamp_ns=index, speed_mps=float(index))
            writer.write("vehicle/state", state, publisher="can", sequence=index, sent_ns=1_000_000 * index)
    return path


@pytest.mark.parametrize(
    ("argv", "code", "text"),
    [
        (["lunch"], 2, "No such command 'lunch'"),
        (["launch"], 2, "Missing argument"),
        (["launch", "nope.yaml"], 2, "nope.yaml: No such file"),
        (["topic", "hz", "nope"], 2, "unknown topic 'nope'"),
        (["bag", "info", "nope.mcap"], 2, "nope.mcap: no such file"),
        (["topic", "list", "--domain", "../x"], 2, "domain must be"),
    ],
)
def test_errors_are_one_line_and_a_code(
    argv: list[str], code: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(argv) == code
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


def test_version_and_help_end_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("mirrorwave ")
    assert main(["--help"]) == 0
    assert "launch" in capsys.readouterr().out


@pytest.mark.parametrize(
    "words",
    ["-h", "help", "sim -h", "sim help", "help sim", "sim effects -h", "sim effects help", "help sim effects",
     "sim import help", "doctor -h", "doctor help", "launch help", "param set -h"],
)  # fmt: skip
def test_help_is_asked_for_in_any_way(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.split()) == 0
    verbs = " ".join(word for word in words.split() if word not in ("-h", "help"))
    assert capsys.readouterr().out.startswith(f"Usage: mirrorwave {verbs}".rstrip())


def test_the_whole_help_lists_each_verb_once_with_an_example_that_its_parser_takes(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert set(cli._EXAMPLES) == set(cli._VERBS) | set(cli._GROUPS)
    assert max(map(len, lines)) <= 80
    for verb, example in cli._EXAMPLES.items():
        assert sum(line.startswith(f"  {verb} ") for line in lines) == 1
        assert f"$ mirrorwave {example}" in {line.strip() for line in lines}
        command, words = get_command(command_line(verb)), example.split()
        while isinstance(command, TyperGroup) and words:
            command = command.get_command(Context(command), words.pop(0))
        assert command is not None
        command.make_context(verb, words)


def test_options_are_taken_by_their_former_names(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "--jobs", "0"]) == 2
    assert "'--workers'" in capsys.readouterr().err
    assert main(["tradeoff", "--frames=0"]) == 2
    assert "'--count'" in capsys.readouterr().err
    assert main(["eval", "--places", "3", "--data", "d"]) == 2
    assert capsys.readouterr().err == "mirrorwave: --count must not be given with --data\n"
    assert main(["sim", "dataset", "--places", "nowhere", "--count", "1", "--out", "d"]) == 2
    assert "'--places'" in capsys.readouterr().err, "the kind of place, in another verb"
    for verb, former in (("compare", "--jobs"), ("tradeoff", "--frames"), ("eval", "--places")):
        assert main([verb, "--help"]) == 0
        assert former not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["launch", "launch/scenes/corner.yaml"], "is a scene, no launch file; to run it live: mirrorwave launch"),
        (["launch", "launch/samples/side_street.mcap"], "is a recording, no launch file; mirrorwave process"),
        (["sim", "effects", "launch/corner.yaml"], "is a launch file, no scene"),
        (["process", str(LAUNCH / "scenes/corner.yaml")], "mirrorwave sim run SCENE --out NAME.mcap records a scene"),
        (["topic", "echo", "hidden_objects"], "; did you mean 'perception/hidden_objects'?"),
        (["topic", "hz", "radar/ramap"], "; did you mean 'radar/ra_map'?"),
        (["launch", "launch/corner.yaml", "-p", "geomtry.walls=1"], "; did you mean 'geometry'?"),
        (["launch", "launch/corner.yaml", "-p", "geometry.object_treshold=1"], "; did you mean 'object_threshold'?"),
        (["launch", "launch/corner.yaml", "-p", "geometry.object_threshold=abc"], "Expected float | null, got str"),
        (["launch", "launch/corner.yaml", "-p", "geometry.object_threshold=7"], "must lie in 0..1, got 7.0"),
        (["launch", "launch/corner.yaml", "--profile", "acurate"], "; did you mean 'accurate'?"),
        (["sim", "material", "conrete"], "; did you mean 'concrete'?"),
    ],
)  # fmt: skip
def test_a_slip_is_named_with_what_was_meant_before_anything_starts(
    words: list[str], said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mirrorwave.commands.graph.launch.run_graph", lambda *_, **__: pytest.fail("was started"))
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    answer = capfd.readouterr()
    assert (answer.out, answer.err.count("\n")) == ("", 1)
    assert said in answer.err


def test_sound_parameters_start_the_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    started = []
    monkeypatch.setattr(
        "mirrorwave.commands.graph.launch.run_graph", lambda graph, *_, **__: started.append(graph) or 0
    )
    assert main(["launch", "launch/corner.yaml", "-p", "geometry.object_threshold=0.5"]) == 0
    assert started[0].nodes["geometry"].params["object_threshold"] == 0.5


def test_bag_info_tells_what_a_recording_holds(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bag", "info", str(recording), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["topics"][0]["messages"] == 10
    assert main(["bag", "info", str(recording)]) == 0
    assert "vehicle/state" in capsys.readouterr().out


def test_a_module_that_ends_early_is_an_error_and_no_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As a full disk leaves it: Python 3.11 keeps what fitted of a compiled module."""
    (tmp_path / "cut_module.pyc").write_bytes(importlib.util.MAGIC_NUMBER + bytes(12) + b"\xe3")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("msgs.recording.mcap.info", lambda path: __import__("cut_module"))
    (tmp_path / "a.mcap").touch()
    assert main(["bag", "info", str(tmp_path / "a.mcap")]) == 1
    assert "mirrorwave: marshal data too short" in capsys.readouterr().err


def test_trim_keeps_the_span(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "b.mcap"
    assert main(["bag", "trim", str(recording), str(out), "--start", "0.002", "--end", "0.005"]) == 0
    assert sum(topic.messages for topic in info(out).topics) == 3
    assert main(["bag", "trim", str(recording), str(tmp_path / "c.mcap"), "--start", "2", "--end", "1"]) == 2


def test_topic_list_covers_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    from msgs.bus.topics import TOPICS

    assert main(["topic", "list", "--json"]) == 0
    assert [row["topic"] for row in json.loads(capsys.readouterr().out)] == list(TOPICS)


def test_errors_know_their_code() -> None:
    assert exit_code_of(ValueError("x")) == exit_code_of(FileNotFoundError(2, "no", "f")) == 2
    assert exit_code_of(OSError(28, "full", "f")) == 1
    assert error_line(OSError(28, os.strerror(28), "f")) == "f: No space left on device"


#: Verbs without --json, and why: all others inspect.
WITHOUT_JSON = {
    "demo": "runs a graph; its log is the output",
    "launch": "runs a graph; its log is the output",
    "view": "serves a page until it is ended",
    "sim run": "writes a capture, which is the output",
    "sim lidar": "writes clouds, which are the output",
    "train residual": "trains; the card of the network is the output",
    "bag record": "records until it is ended",
    "bag recover": "writes a recording, which `bag info --json` describes",
    "bag filter": "writes a recording, which `bag info --json` describes",
    "bag merge": "writes a recording, which `bag info --json` describes",
    "topic pub": "publishes; `topic echo --json` shows it",
    "node kill": "sends a signal; `node list --json` shows what became of it",
}
#: Inspecting verbs that answer without long work or input, and how they are called here.
QUICK = (
    ["doctor"],
    ["graph", "launch/corner.yaml"],
    ["topic", "list"],
    ["topic", "info", "vehicle/state", "--duration", "0.2"],
    ["sim", "material", "concrete"],
    ["sim", "paths", "launch/scenes/corner.yaml"],
)


def verbs() -> dict[str, Any]:
    """Every verb by its words."""

    def walk(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        for name, part in getattr(command, "commands", {}).items():
            yield from walk(part, (*words, name))
        if not hasattr(command, "commands"):
            yield " ".join(words), command

    return dict(walk(get_command(command_line()), ()))


def helps(width: int) -> Iterator[tuple[str, str, list[str]]]:
    """Words, help and the texts it is to hold, of every verb and group, in a terminal of a width."""

    def walk(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, str, list[str]]]:
        context = Context(command, info_name=" ".join(("mirrorwave", *words)), terminal_width=width)
        parts = getattr(command, "commands", {})
        shown = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
        wanted = [parameter.help for parameter in shown if getattr(parameter, "help", None)]
        wanted += [part.help.split("\n\n")[0] for part in parts.values() if not part.hidden]
        yield " ".join(words), command.get_help(context), [*wanted, command.help]
        for name, part in parts.items():
            yield from walk(part, (*words, name))

    return walk(get_command(command_line()), ())


def unwrapped(text: str) -> str:
    """A text as it is before lines are broken."""
    return "".join(text.split())


@pytest.mark.parametrize("width", [60, 80, 120])
def test_no_help_is_cut(width: int) -> None:
    """All that is said of verbs, arguments and options stands in the help."""
    seen = 0
    for words, text, wanted in helps(width):
        assert "\N{HORIZONTAL ELLIPSIS}" not in text
        for one in wanted:
            assert unwrapped(one) in unwrapped(text), (words, one)
        seen += len(wanted)
    assert seen > 300


def test_arguments_are_named_in_capitals_and_the_parser_says_how_many() -> None:
    arguments = {
        str(part.metavar) for verb in verbs().values() for part in verb.params if part.param_type_name == "argument"
    }
    assert all(re.fullmatch(r"[A-Z_=|]+(\.yaml)?", name) for name in arguments), arguments
    assert {"RECORDING", "SCENE", "TOPIC", "LAUNCH_FILE"} < arguments


def test_every_inspecting_verb_has_json() -> None:
    without = {
        words for words, verb in verbs().items() if not any("--json" in parameter.opts for parameter in verb.params)
    }
    assert without <= set(WITHOUT_JSON)


@pytest.mark.parametrize("words", QUICK, ids=" ".join)
def test_what_json_prints_is_json(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, "--json"]) == 0
    json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("topic echo perc", ["perception/peaks", "perception/hidden_objects"]),
        ("graph launch/corner.", ["launch/corner.yaml"]),
        ("launch launch/corner.yaml --profile acc", ["accurate"]),
        ("sim run launch/scenes/two_h", ["launch/scenes/two_hidden_vehicles.yaml"]),
        ("sim material concr", ["concrete"]),
        ("node info no_such", []),
        ("top", ["top", "topic"]),
    ],
)
def test_the_shell_completes(
    words: str, offered: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COMP_WORDS", f"mirrorwave {words}")
    monkeypatch.setenv("COMP_CWORD", str(len(words.split())))
    monkeypatch.setenv("_MIRRORWAVE_COMPLETE", "complete_bash")
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().out.split() == offered


def test_nodes_are_completed_from_their_sockets(monkeypatch: pytest.MonkeyPatch) -> None:
    folder = Path(os.environ["MIRRORWAVE_RUN_DIR"]) / "other"
    folder.mkdir()
    for name in ("radar.ra_map@ra_former", "log@ra_former", "log@player", "supervisor.lock"):
        (folder / name).touch()
    context = SimpleNamespace(params={"domain": "other"})
    assert complete_nodes(context, "") == ["player", "ra_former"]  # type: ignore[arg-type]
    assert complete_nodes(context, "ra") == ["ra_former"]  # type: ignore[arg-type]
    assert complete_nodes(SimpleNamespace(params={}), "") == []  # type: ignore[arg-type]
