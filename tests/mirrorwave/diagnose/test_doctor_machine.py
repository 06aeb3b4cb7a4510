"""The doctor names what fails and why."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest

from mirrorwave.diagnose.doctor_graph import graph_findings
from mirrorwave.diagnose.doctor_machine import check_packages, check_processor, check_run_dir, check_weights
from mirrorwave.diagnose.findings import Status
from mirrorwave.diagnose.node_types import plugin_findings
from msgs.files.plugins import EFFECTS
from tests.plugins import write_package


def test_packages_load_and_a_quiet_domain_is_well(tmp_path: Path) -> None:
    assert {finding.status for finding in check_packages()} == {Status.OK}
    assert {finding.status for finding in [*check_run_dir(tmp_path), *graph_findings(tmp_path)]} == {Status.OK}


@pytest.mark.parametrize(
    ("card", "status"),
    [
        (None, Status.FAILED),
        ({"sha256": "0"}, Status.FAILED),
        ({"sha256": hashlib.sha256(b"n").hexdigest()}, Status.OK),
    ],
)
def test_weights_must_be_what_their_card_says(tmp_path: Path, card: dict | None, status: Status) -> None:
    (tmp_path / "net.onnx").write_bytes(b"n")
    if card is not None:
        (tmp_path / "net.json").write_text(json.dumps(card))
    assert [finding.status for finding in check_weights(tmp_path)] == [status]


def test_effects_of_other_packages_are_told_with_what_is_wrong(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    half = "ABOUT = 'half'\ndef absent(world): ...\ndef factor(echoes, world, used): ..."
    points, sources = {"half": "acme_half", "bad": "acme_bad"}, {"acme_half": half, "acme_bad": "ABOUT = absent = 1"}
    monkeypatch.syspath_prepend(write_package(tmp_path, "acme", EFFECTS, points, **sources))
    assert plugin_findings() == [
        (
            "effect bad of acme 1.2",
            Status.FAILED,
            "acme_bad must define apply(tracing) or factor(echoes, world, used), one of",
        ),
        ("effect half of acme 1.2", Status.OK, "can be used"),
    ]


@pytest.mark.parametrize(("free_mib", "status"), [(1023, Status.WARNING), (1024, Status.OK)])
def test_a_graph_needs_a_gibibyte_that_is_free(free_mib: int, status: Status, monkeypatch: pytest.MonkeyPatch) -> None:
    memory = SimpleNamespace(available=free_mib << 20, free=0, total=1 << 36)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)
    found = {finding.check: (finding.status, finding.detail) for finding in check_processor()}
    assert found["memory"] == (status, f"{free_mib} MiB available")
    assert found["compiler"][0] is Status.OK
