"""What all verbs print with: tables that fit a terminal, progress that never falls silent."""

from __future__ import annotations

import io
import re
import threading
from collections.abc import Callable, Sequence
from random import Random

import pytest
from rich.console import Console

from lab.compare import comparison_report as compare
from lab.tradeoff import row_report as tradeoff
from mirrorwave import console
from mirrorwave.cli import main
from mirrorwave.commands.graph import nodes, top
from mirrorwave.console import Progress, console_table, print_table, progress_bar
from mirrorwave.plots.scoreboard import Scoreboard
from models.compiled import KernelCache
from msgs.files.shipped import LAUNCH, SAMPLE
from msgs.values.diagnostics import NodeState, NodeStatus, ShedCount, TopicCount
from msgs.values.perception import BevFrame, HiddenObject, SceneTruth, TruthObject
from tests.mirrorwave.plots.test_scoreboard import frame, truth


def some_table(seed: int) -> tuple[list[str], list[list[object]], list[str], int]:
    """Columns with headings and cells of any length, those that may leave, and a width."""
    random = Random(seed)

    def text() -> str:
        return " ".join(
            "".join(random.choices("abc-/_", k=random.randint(1, 28))) for _ in range(random.choice((1, 2, 9)))
        )

    def cell() -> object:
        return random.choice(
            (text, lambda: random.randint(-999, 10**9), lambda: random.uniform(-999, 999), lambda: None)
        )()

    columns = list(dict.fromkeys(text().upper() for _ in range(random.randint(1, 12))))
    rows = [[cell() for _ in columns] for _ in range(random.randint(0, 4))]
    return columns, rows, random.sample(columns, random.randint(0, len(columns))), random.randint(40, 200)


def drawn(columns: Sequence[str], rows: Sequence[Sequence[object]], drop: Sequence[str], width: int) -> str:
    out = io.StringIO()
    Console(file=out, width=width).print(console_table(columns, rows, drop, width))
    return out.getvalue()


@pytest.mark.parametrize("seed", range(60))
def test_no_heading_and_no_cell_of_a_kept_column_is_lost_at_any_width(seed: int) -> None:
    columns, rows, drop, width = some_table(seed)
    text = drawn(columns, rows, drop, width)
    assert "…" not in text
    assert max(map(len, text.splitlines()), default=0) <= width
    # a long word may be broken between lines
    shown = re.sub(r"\s", "", text)
    words = set(text.split())
    for index, column in enumerate(columns):
        assert set(column.split()) <= words or all(word in shown for word in column.split()), column
        if column not in drop:
            cells = [console._cell(row[index]) for row in rows]
            assert all(word in words or len(word) > 20 for cell in cells for word in cell.split()), cells


def test_no_figure_below_a_million_has_an_exponent() -> None:
    assert [console._cell(value) for value in (9.996, 999.4, 999.7, 1000.4, 123456.7)] == [
        "10", "999", "1000", "1000", "123457",
    ]  # fmt: skip


def test_columns_leave_in_their_order_and_are_named() -> None:
    columns, row = ("NODE", "STATE", "PID", "IN_HZ", "REASON"), ["ra_former", "degraded", 12345, 3.3, "b " * 40]
    whole = drawn(columns, [row], ("PID", "IN_HZ"), 120)
    assert "left out" not in whole
    text = drawn(columns, [row], ("PID", "IN_HZ"), 50)
    assert text.splitlines()[0].split() == ["NODE", "STATE", "IN_HZ", "REASON"]
    assert "left out at this width: PID;" in text


def test_what_fits_at_no_rate_is_a_block_a_row() -> None:
    text = drawn(("verdict", "detail"), [["w" * 18, "x" * 30], ["passed", "fine"]], (), 32)
    assert text.split("\n\n")[0].splitlines() == [f"verdict: {'w' * 18}", "detail: ", "x" * 30]
    assert "verdict: passed" in text


def test_no_line_is_cut_or_wrapped_where_stdout_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("why",), [("long " * 600,)])
    assert len(capsys.readouterr().out.splitlines()) == 2


LONG = "falls behind: 12 scans were left out in the last 5 s because detection takes 420 ms of the 300 ms there are"


def _nodes() -> dict[str, list[NodeStatus]]:
    counts = (TopicCount(topic="radar/beam", messages=123456, bytes=987654321, lost=4321, rejected=12, outdated=345),)
    beats = {}
    for name in ("dense_predictor", "foxglove_server", "vehicle/geometry"):
        first, last = (
            NodeStatus(
                stamp_ns=0, node=name, pid=1234567, state=NodeState.DEGRADED, reason=LONG, uptime_s=uptime_s,
                cpu_s=uptime_s, resident_bytes=123456789, received=counts, published=counts,
                shed=(ShedCount(what="scan", reason="behind", count=1234),),
            )
            for uptime_s in (12345.0, 12346.0)
        )  # fmt: skip
        beats[name] = [first, last]
    return beats


def _scoreboard() -> None:
    board = Scoreboard()
    seen, there = truth(0), []
    for number in range(12):
        there.append(HiddenObject(**_box(number, 20.25 - 4.1 * number), score=0.9876, cov_m2=((1.0, 0.0), (0.0, 1.0))))
    objects = tuple(
        TruthObject(object_class="pedestrian", hidden=True, **_box(number, 20.0 - 8.2 * number)) for number in range(12)
    )
    board.add_truth(SceneTruth(**{**_fields(seen), "objects": objects}))
    board.add_frame(BevFrame(**{**_fields(frame(0)), "objects": tuple(there)}))
    board.print_table()


def _box(number: int, x_m: float) -> dict[str, float]:
    return {"id": number, "x_m": x_m, "y_m": -13.25, "length_m": 0.6, "width_m": 0.6, "yaw_rad": 0.0}


def _fields(value: object) -> dict[str, object]:
    return {name: getattr(value, name) for name in value.__struct_fields__}


def _tradeoff() -> None:
    row = ["network: unet at twice the width", "0.612 [0.580, 0.640]", "`default` +0.012 [-0.010, +0.030]",
           *["0.881"] * 5, *["1234.5"] * 7, "12.25", "97 %", "1234", "123456", "yes"]  # fmt: skip
    print_table(tradeoff.COLUMNS, [row], tradeoff.LEAST)


def _compare() -> None:
    interval = "0.812 [0.700, 0.900]"
    named = ["range_glass", "double_glazing", "spad_gated (12 scans)"]
    row = [*named, *[interval] * 3, *["12.3"] * 5, "3.1..3.8", "123.45"]
    print_table(("sweep", "value", *compare.COLUMNS), [row], compare.LEAST)


def _top() -> None:
    rows = [{**nodes.node_row(beats), "stages": []} for beats in _nodes().values()]
    print_table(top._NODE_COLUMNS, [top._node_cells(row) for row in rows], top._LEAST)


def _run(*words: str) -> Callable[[], None]:
    return lambda: main([str(word) for word in words]) and None


#: What prints, the headings that must stay, and words of verdicts that must be whole.
PRINTED: dict[str, tuple[Callable[[], None], str, str]] = {
    "sim effects": (_run("sim", "effects", LAUNCH / "scenes/corner.yaml", "--effects", "basic"),
                    "effect bound cost why", "used skipped quantised_phases object_interreflection"),
    "sim paths": (_run("sim", "paths", LAUNCH / "scenes/corner.yaml", "--hidden-only", "--top", "3"),
                  "kind order length azimuth dBm object by way of", "mnlos specular_relay"),
    "sim material": (_run("sim", "material"), "material R 10 77 GHz", "insulated_wall double_glazing"),
    "bag info": (_run("bag", "info", SAMPLE), "TOPIC MESSAGES HZ PUBLISHERS", "radar/beam player"),
    "topic list": (_run("topic", "list"), "TOPIC TYPE NOMINAL HZ PUBLISHERS", "perception/hidden_objects"),
    "node types": (_run("node", "types"), "MODULE ABOUT", "nodes.dense_predictor"),
    "node list": (_run("node", "list"), "NODE STATE LOST SHED REASON", f"vehicle/geometry degraded 4321 {LONG}"),
    "node info": (_run("node", "info", "vehicle/geometry"), "WAY TOPIC HZ LOST", "in out 4321 12346"),
    "top": (_top, "NODE STATE LOST REASON", f"degraded vehicle/geometry {LONG}"),
    "scoreboard": (_scoreboard, "hidden object truth true error: centre nearest visible face [m] unmatched",
                   "pedestrian nothing missed"),
    "tradeoff": (_tradeoff, "row object F1 p50 late front", "twice yes 97"),
    "compare": (_compare, "sweep value sensor F1 1 m", "range_glass double_glazing 0.812"),
}  # fmt: skip


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize("verb", PRINTED)
def test_tables_of_long_content_keep_headings_and_verdicts_at_80_and_120_columns(
    verb: str, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "stdout_console", lambda: Console(width=width))
    monkeypatch.setattr(nodes, "_heartbeats", lambda domain, window_s: _nodes())
    print_it, headings, verdicts = PRINTED[verb]
    print_it()
    text = capsys.readouterr().out
    assert "…" not in text
    assert not set(headings.split()) - set(text.split())
    assert not set(verdicts.split()) - set(text.replace(",", " ").split())
    left_out = re.findall(r"left out at this width: (.*?);", text, re.DOTALL)
    assert not any(set(names.replace(",", " ").split()) & {"STATE", "REASON", "TOPIC", "why"} for names in left_out)


def test_progress_off_a_terminal_is_a_line_of_what_is_done_and_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Lines come from a thread of their own: also while one step takes long."""
    monkeypatch.setattr(console, "BEAT_S", 0.01)
    written = threading.Event()
    monkeypatch.setattr(console, "_heartbeat", lambda line: (lines.append(line), written.set()))
    lines: list[str] = []
    with progress_bar("places", 240) as advance:
        advance.keep(40)
        advance(100)
        advance._start_s -= 50.0
        written.clear()
        assert written.wait(60.0)
        advance.print("epoch 1")
    assert lines[-2] == "places: 140 of 240, 50 s, 50 s left", "what was kept took no time"
    assert lines[-1] == "epoch 1"
    assert capsys.readouterr().out == "", "stdout is for results"
    assert console._bar("places", 240).console.stderr, "on a terminal too"


def test_progress_says_that_kernels_are_compiled_until_something_is_done(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KernelCache, "compiled", 31)
    progress = Progress("scans", 12, 0, print)
    assert progress.line() == "scans: 0 of 12, 0 s, 31 kernels compiled, which are kept"
    progress(3)
    assert "kernels" not in progress.line()
