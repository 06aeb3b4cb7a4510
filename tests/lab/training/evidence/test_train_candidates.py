"""From an evidence network to the second look at what it proposes: samples, training, export, use."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lab.training.data.evidence_store import CandidateTask, EvidenceTask, load_candidates, load_truths
from lab.training.evidence.grid_training import GridSchedule
from lab.training.evidence.runs import CandidateRun
from lab.training.run_folder import BEST, load_state
from models.perception.cards import card_path, read_card
from models.perception.see.candidate_predictor import CandidateEncoding, CandidatePredictor
from models.perception.see.detections import PLACE
from models.perception.see.evidence_predictor import EvidenceCard, EvidencePredictor
from models.perception.see.gathering import BirdsEyeGrid
from models.perception.see.scan_evidence import EvidenceEncoding
from sim_player.dataset.shards import Recipe
from sim_player.dataset.writer import write_dataset
from tests.models.perception.see.networks_by_hand import evidence_network

pytestmark = pytest.mark.slow
SCHEDULE = GridSchedule(epochs=2, batch_size=16, mixed_precision=False)


@pytest.fixture(scope="module")
def sets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folders = {name: tmp_path_factory.mktemp(name) for name in ("train", "validation")}
    for seed, folder in enumerate(folders.values()):
        write_dataset(folder, 4, 70 + seed, Recipe(effects="basic", truth=True))
    return folders


def run_of(sets: dict[str, Path], folder: Path, network: Path) -> CandidateRun:
    return CandidateRun(network=network, data=[sets["train"]], validation=[sets["validation"]], folder=folder)


@pytest.fixture(scope="module")
def trained(sets: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> CandidateRun:
    run = run_of(sets, tmp_path_factory.mktemp("run"), evidence_network(tmp_path_factory.mktemp("network")))
    run.train(SCHEDULE)
    return run


def test_samples_say_which_candidates_find_an_object(sets: dict[str, Path], trained: CandidateRun) -> None:
    """Such a one lies no further from something hidden than its half length and a metre; no two find the same."""
    (path,) = (trained.folder / "candidate-samples" / sets["train"].name).glob("*.npz")
    grid, finding, others = BirdsEyeGrid(), 0, 0
    for truth, item in zip(load_truths(path), load_candidates(path), strict=True):
        cell_m = np.stack([grid.x_m[item.row], grid.y_m[item.column]], axis=1)
        hidden = [each for each in truth.truth if each.hidden]
        apart_m = np.array([(each.x_m, each.y_m) for each in hidden]).reshape(-1, 1, 2) - (
            cell_m + item.proposals.values[:, PLACE]
        )
        reach_m = np.array([0.5 * each.length_m + 1.0 for each in hidden]).reshape(-1, 1)
        assert (reach_m > np.hypot(*apart_m.T).T)[:, item.finds].any(axis=0).all()
        assert item.finds.sum() <= len(hidden)
        finding, others = finding + item.finds.sum(), others + (~item.finds).sum()
    assert finding > 0 < others


def test_the_evidence_network_reports_what_the_second_look_leaves(trained: CandidateRun) -> None:
    card = read_card(card_path(trained.network), EvidenceCard)
    assert card.data["candidates"] == trained.file.name == "candidates_of_by_hand.onnx"
    second = CandidatePredictor(trained.file)
    assert second.card.data["evidence_sha256"] == card.sha256
    assert second.card.training["scans"] > SCHEDULE.batch_size
    assert EvidencePredictor(trained.network).card == card


def test_every_other_file_of_samples_looks_both_ways(tmp_path: Path) -> None:
    task = CandidateTask(CandidateEncoding(), tmp_path, EvidenceTask(EvidenceEncoding(), tmp_path, tmp_path))
    assert [task.of_file(number).evidence.flip_test for number in range(4)] == [False, True, False, True]


def test_the_same_seed_gives_the_same_weights(sets: dict[str, Path], trained: CandidateRun, tmp_path: Path) -> None:
    network = evidence_network(tmp_path)
    run_of(sets, tmp_path / "run", network).train(SCHEDULE)
    whole, again = (load_state(folder / BEST)["network"] for folder in (trained.folder, tmp_path / "run"))
    assert all((whole[name] == again[name]).all() for name in whole)


def test_scans_without_candidates_are_refused(sets: dict[str, Path], tmp_path: Path) -> None:
    network = evidence_network(tmp_path, gain=0.0)
    with pytest.raises(ValueError, match="training scans must hold at least 16 candidates, a batch, got 0"):
        run_of(sets, tmp_path / "run", network).train(SCHEDULE)


def test_places_of_the_validation_set_are_not_trained_on(sets: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no scan may share a place with"):
        CandidateRun(network=tmp_path, data=[sets["train"]], validation=[sets["train"]], folder=tmp_path)
