"""A second look at candidates: what is seen of them, from either side, and what a correction does to them."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from scipy.special import logit

from lab.training.export.evidence import write_candidate_network
from lab.training.export.onnx import write_card
from models.perception.cards import card_path, read_card
from models.perception.mirrors.mirror_table import wall_arrays
from models.perception.mirrors.peaks_to_view import GeometryParams, direct_structure
from models.perception.mirrors.peaks_to_view import synthetic_peaks as street_peaks
from models.perception.see.candidate_predictor import (
    ODD_ANSWERS,
    CandidateCard,
    CandidateEncoding,
    CandidateInputs,
    CandidatePredictor,
    candidate_inputs,
    corrected,
)
from models.perception.see.detections import ANSWERS, LOG_SIZE, OBJECT
from models.perception.see.evidence_answers import Candidates, candidates
from models.perception.see.evidence_predictor import EvidenceCard, EvidencePredictor
from msgs.files.checksums import file_sha256
from msgs.values.perception import Wall
from tests.models.perception.see.networks_by_hand import EVIDENCE, echoes, empty_map, evidence_network

ENCODING = CandidateEncoding()
PLANE = EVIDENCE.grid
WALLS = wall_arrays([Wall(normal=(-1.0, 0.0), offset_m=20.0, ends_m=((20.0, -12.0), (20.0, 12.0)), inliers=9)])


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray, Candidates]:
    """Evidence and answers of any kind, and three candidates: at an edge, to the left and to the right."""
    rng = np.random.default_rng(seed)
    channels = rng.uniform(-1.0, 1.0, EVIDENCE.shape).astype(np.float32)
    answer = rng.normal(0.0, 0.3, (ANSWERS, *PLANE.shape)).astype(np.float32)
    answer[OBJECT] = -9.0
    for row, column in ((0, 40), (20, 70), (30, 30)):
        answer[OBJECT, row, column] = 1.0 + 0.1 * row
    return channels, answer, candidates(answer, np.zeros(PLANE.shape, np.int16), 0.1)


def turned(planes: np.ndarray, odd: list[int]) -> np.ndarray:
    """The scene with left and right exchanged."""
    planes = planes[..., ::-1].copy()
    planes[odd] *= -1.0
    return planes


def test_left_and_right_are_seen_alike() -> None:
    """All that is seen of a candidate is what is seen of its mirror image in the mirrored scene."""
    channels, answer, proposals = scene()
    seen = candidate_inputs(ENCODING, proposals, WALLS, channels, answer, moving=True)
    other = candidates(turned(answer, ODD_ANSWERS), np.zeros(PLANE.shape, np.int16), 0.1)
    mirrored = candidate_inputs(
        ENCODING, other, WALLS, turned(channels, EVIDENCE.odd_channels), turned(answer, ODD_ANSWERS), moving=True
    )
    np.testing.assert_array_equal(seen.mirrored, ~mirrored.mirrored)
    np.testing.assert_allclose(seen.places, mirrored.places, atol=1e-6)
    np.testing.assert_allclose(seen.facts, mirrored.facts, atol=1e-6)


def test_what_is_seen_lies_about_the_candidate() -> None:
    """Its own cell in the middle, its neighbours in order, nothing beyond the plane's edge."""
    channels, answer, proposals = scene()
    seen = candidate_inputs(ENCODING, proposals, WALLS, channels, answer, moving=True)
    assert {name: getattr(seen, name).shape[1:] for name in ENCODING.shapes} == ENCODING.shapes
    left = np.flatnonzero(~seen.mirrored)
    for index in left:
        row, column = proposals.row[index], proposals.column[index]
        np.testing.assert_array_equal(seen.places[index, :-1, 3, 3], channels[:, row, column])
        np.testing.assert_array_equal(seen.places[index, :-1, 4, 2], channels[:, row + 1, column - 1])
    (edge,) = np.flatnonzero(proposals.row == 0)
    assert not seen.places[edge, :, :3].any()
    assert np.abs(seen.facts).max() < 10.0


def test_a_correction_is_added_to_the_logit_alone() -> None:
    _, _, proposals = scene()
    moved = corrected(proposals, np.array([0.5, -1.0, 0.0], np.float32))
    np.testing.assert_allclose(moved.values[:, 0] - proposals.values[:, 0], [0.5, -1.0, 0.0])
    np.testing.assert_array_equal(moved.values[:, 1:], proposals.values[:, 1:])
    assert proposals.values[0, 0] != moved.values[0, 0]


def test_the_likeliest_different_objects_are_looked_at() -> None:
    """Of two places in one box the likelier one, and no more than asked for."""
    _, answer, proposals = scene()
    answer[OBJECT, 21, 72] = 0.5
    answer[LOG_SIZE] = np.log(4.0)
    mirror = np.zeros(PLANE.shape, np.int16)
    every = ENCODING.candidates(answer, mirror, WALLS)
    assert sorted(every.values[:, 0]) == sorted(proposals.values[:, 0])
    assert (np.diff(every.values[:, 0]) <= 0.0).all()
    few = msgspec.structs.replace(ENCODING, most=2).candidates(answer, mirror, WALLS)
    np.testing.assert_array_equal(few.values, every.values[:2])


@pytest.mark.parametrize(("name", "value"), [("least", 1.5), ("most", 0), ("reach", 0)])
def test_parameters_without_sense_are_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"candidates\.{name} must"):
        CandidateEncoding(**{name: value})


class Always(torch.nn.Module):
    """Corrects every candidate alike."""

    def __init__(self, by: float) -> None:
        super().__init__()
        self.correction = torch.nn.Parameter(torch.tensor(by))

    def forward(self, places: torch.Tensor, facts: torch.Tensor) -> torch.Tensor:
        return self.correction + 0.0 * (facts[:, 0] + places.mean(dim=(1, 2, 3)))


def second_look(network: Path, module: torch.nn.Module, encoding: CandidateEncoding = ENCODING) -> Path:
    """Write a candidate network and name it in the card of an evidence network."""
    path = network.with_name("second.onnx")
    write_candidate_network(module, encoding, path)
    card = CandidateCard(name="second", sha256=file_sha256(path), parameters=0, encoding=encoding)
    write_card(card, path)
    own = read_card(card_path(network), EvidenceCard)
    named = {"candidates": path.name, "candidates_sha256": card.sha256}
    write_card(msgspec.structs.replace(own, data={**own.data, **named}), network)
    return path


def scores_of(network: Path, *images_m: tuple[float, float], threshold: float = 0.5) -> list[float]:
    """What a network finds behind the facade at x = 20 m."""
    _, walls = direct_structure(street_peaks(), GeometryParams())
    judge = EvidencePredictor(network, threshold=threshold).judge(empty_map(values=echoes(*images_m)), walls)
    return [each.score for each in judge()]


def test_a_second_look_decides_what_is_reported(tmp_path: Path) -> None:
    """A logit of 1 less, then of 30 less: the same echoes are less likely objects, then none."""
    network, images_m = evidence_network(tmp_path), ((27.0, -9.0), (27.0, 7.0))
    plain = scores_of(network, *images_m)
    second_look(network, Always(-1.0))
    assert plain
    np.testing.assert_allclose(logit(scores_of(network, *images_m)), logit(plain) - 1.0, atol=1e-6)
    second_look(network, Always(-30.0))
    assert scores_of(network, *images_m) == []


def test_a_map_of_nothing_has_no_candidates(tmp_path: Path) -> None:
    network = evidence_network(tmp_path)
    second_look(network, Always(50.0))
    assert scores_of(network, (60.0, 50.0)) == []


def test_answers_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    network = evidence_network(tmp_path)
    path = second_look(network, Always(float("nan")))
    empty = CandidateInputs(
        *(np.zeros((0, *shape), np.float32) for shape in ENCODING.shapes.values()), np.zeros(0, bool)
    )
    assert CandidatePredictor(path).correction(empty).shape == (0,)
    with pytest.raises(ValueError, match=r"second\.onnx: answers must be finite"):
        scores_of(network, (27.0, -9.0))


def test_a_second_look_of_another_evidence_network_is_refused(tmp_path: Path) -> None:
    """Another file, another plane, a file that is not there, a network of other inputs: each is named."""
    network = evidence_network(tmp_path)
    path = second_look(network, Always(0.0))
    card = read_card(card_path(path), CandidateCard)
    wider = msgspec.structs.replace(ENCODING, evidence=msgspec.structs.replace(EVIDENCE, max_walls=3))
    write_card(msgspec.structs.replace(card, encoding=wider), path)
    with pytest.raises(ValueError, match=r"encoding\.evidence must be that of"):
        EvidencePredictor(network)
    write_card(msgspec.structs.replace(card, encoding=msgspec.structs.replace(ENCODING, reach=2)), path)
    with pytest.raises(ValueError, match=r"inputs of the network must be .*'places': \[71, 5, 5\]"):
        EvidencePredictor(network)
    write_card(card, path)
    own = read_card(card_path(network), EvidenceCard)
    write_card(msgspec.structs.replace(own, data={**own.data, "candidates_sha256": "0" * 64}), network)
    with pytest.raises(ValueError, match=r"candidate network must have the sha256 0{64} of its card"):
        EvidencePredictor(network)
    path.unlink()
    write_card(own, network)
    with pytest.raises(ValueError, match=r"second\.onnx: No such file"):
        EvidencePredictor(network)
