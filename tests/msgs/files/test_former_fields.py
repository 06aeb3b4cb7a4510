"""Files that name a former parameter load with a line about it; a slip is refused as before."""

from __future__ import annotations

import importlib
import json
import logging
from pathlib import Path
from typing import Any

import pytest

from mirrorwave.reference import node_modules
from models.perception.cards import read_card
from models.perception.see.evidence_predictor import DEFAULT_EVIDENCE, EvidenceCard
from msgs.bus.local import LocalNetwork
from msgs.values.node_params import ParamRequest
from nodes import dense_predictor, detection_peaks, geometry
from nodes.process import validation
from nodes.process.param_server import ParamServer

MIRRORS = "models.perception.mirrors"


@pytest.fixture(autouse=True)
def _warn_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "_WARNED", set())


@pytest.mark.parametrize(
    ("wanted", "given", "kept", "lines"),
    [
        (geometry.Params, {"cluster_eps_m": 3.0}, {}, [f"cluster_eps_m is a constant: {MIRRORS}.peaks_to_view."]),
        (geometry.Params, {"walls": {"rounds": 50, "open_gap_m": 0.0}}, {},
         [f"walls.rounds is a constant: {MIRRORS}.walls.WallParams.rounds;",
          f"walls.open_gap_m is a constant: {MIRRORS}.walls.OPEN_GAP_M;"]),
        (geometry.Params, {"memory": {"tracker": {"max_gap_s": 1.0, "confirm_existence": 0.5}}},
         {"memory": {"tracker": {"confirm_existence": 0.5}}},
         ["memory.tracker.max_gap_s is a constant: models.perception.track.tracker.MAX_GAP_S;"]),
        (geometry.Params, {"walls": {"arcs": {"min_gain": 1.0}}}, {},
         [f"walls.arcs.min_gain is a constant: {MIRRORS}.arcs.MIN_GAIN;"]),
        (geometry.Params, {"confidence": "auto"}, {}, ["confidence has left; the value here is not used"]),
        (geometry.Params, {"recovery": {"reject_on_wall": False}}, {},
         ["recovery.reject_on_wall has left;"]),
        (geometry.Params, {"objects": {"min_score": 0.5, "score_table": []}, "back_end": "ours"}, {},
         [f"objects.min_score is a constant: {MIRRORS}.recovered_objects.MIN_SCORE;", "objects.score_table is"]),
        (geometry.Params, {"detections": {"visibility": {"rcs_dbsm": 0.0}, "walls": {"min_inliers": 5}}},
         {"detections": {"walls": {"min_inliers": 5}}}, ["detections.visibility.rcs_dbsm is a constant:"]),
        (detection_peaks.Params, {"geometry": {"walls": {"max_gap_m": 4.0}, "wall_points": None}}, {},
         ["geometry.walls.max_gap_m is a constant:", "geometry.wall_points has left;"]),
        (dense_predictor.Params, {"cfar": {"ridges": {"min_snr_db": 9.0}, "peaks": {"min_distance": 2}}}, {},
         ["cfar.ridges.min_snr_db is a constant:", "cfar.peaks.min_distance is a constant:"]),
    ],
)  # fmt: skip
def test_a_former_parameter_is_left_out_with_a_line(
    wanted: Any, given: dict[str, Any], kept: dict[str, Any], lines: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """Once, however often the file is converted on its way to the node."""
    caplog.set_level(logging.WARNING)
    for _ in range(2):
        assert validation.convert_at(given, wanted, "old.yaml: node") == validation.convert_at(kept, wanted, "")
    assert len(caplog.messages) == len(lines)
    for message, line in zip(caplog.messages, lines, strict=True):
        assert message.startswith(f"old.yaml: node.{line}")


@pytest.mark.parametrize("module_name", node_modules())
def test_the_constants_of_all_nodes_are_there(module_name: str) -> None:
    """A module that moves takes its entry along."""
    for constants in getattr(importlib.import_module(module_name).Params, "formerly", {}).values():
        importlib.import_module(constants)


@pytest.mark.parametrize(
    ("given", "place"),
    [({"memory": {"magic": 1}}, "node.memory"), ({"clusters_m": 3.0}, "node"), ({"grid": {"cell": 1}}, "node.grid")],
)
def test_a_slip_is_refused(given: dict[str, Any], place: str) -> None:
    with pytest.raises(ValueError, match=rf"^{place}: Object contains unknown field .*; known are"):
        validation.convert_at(given, geometry.Params, "node")


def test_a_running_node_refuses_to_change_a_constant() -> None:
    """There is nothing that could change."""
    bus = LocalNetwork().bus("geometry")
    server = ParamServer(bus, "geometry", geometry.Params(), lambda _: None)
    request = ParamRequest(stamp_ns=0, request="1", node="geometry", changes='{"objects": {"min_score": 0.1}}')
    assert server._changed(request).startswith("objects.min_score is a constant:")


@pytest.mark.parametrize(("value", "refused"), [(2.0, False), (0.0, True)])
def test_a_card_may_name_a_constant_by_its_own_value(value: float, refused: bool, tmp_path: Path) -> None:
    """The network was trained with it."""
    card = json.loads(DEFAULT_EVIDENCE.with_suffix(".json").read_text())
    card["encoding"]["walls"]["open_gap_m"] = value
    path = tmp_path / "card.json"
    path.write_text(json.dumps(card))
    if refused:
        with pytest.raises(ValueError, match=r"encoding.walls.open_gap_m must be 2.0, as .*OPEN_GAP_M, got 0.0"):
            read_card(path, EvidenceCard)
    else:
        assert read_card(path, EvidenceCard) == read_card(DEFAULT_EVIDENCE.with_suffix(".json"), EvidenceCard)
