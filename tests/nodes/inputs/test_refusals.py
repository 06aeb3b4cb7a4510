"""Refused input: each is counted, a reason is said once, and health is back with the next accepted."""

from __future__ import annotations

import logging

import pytest

from msgs.values.diagnostics import NodeState
from nodes.inputs.refusals import Refusals
from nodes.node import ShedTally


@pytest.mark.parametrize(
    ("unit", "lines"),
    [
        ("beam", ["no (1 beam refused so far)", "nor (3 beams refused so far)", "no (4 beams refused so far)"]),
        (None, ["the beam refused: no", "beam refused: nor", "beam refused: no"]),
    ],
)
def test_a_reason_is_said_when_it_changes(unit: str | None, lines: list[str], caplog: pytest.LogCaptureFixture) -> None:
    shed = ShedTally()
    refusals = Refusals(logging.getLogger("refusals"), shed, unit)
    refusals.refuse("beam", ValueError("no"), "the beam")
    refusals.refuse("beam", ValueError("no"), "the beam")
    refusals.refuse("beam", ValueError("nor"))
    assert refusals.health() == (NodeState.DEGRADED, "nor")
    refusals.accept()
    assert refusals.health() == (NodeState.READY, "")
    refusals.refuse("beam", ValueError("no"))
    # another kind is counted by its own name and not as a beam
    refusals.refuse("setup", ValueError("none"))
    shed.add("setup", "refused", 2)
    assert [record.message for record in caplog.records] == [*lines, "setup refused: none"]
    assert [(one.what, one.reason, one.count) for one in shed.counts()] == [
        ("beam", "refused", 4), ("setup", "refused", 3),
    ]  # fmt: skip
