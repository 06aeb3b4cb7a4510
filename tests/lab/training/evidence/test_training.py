"""From drawn places to networks on the vehicle: samples, two trainings, export, a scan judged."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from scipy.special import expit

from lab.training.data import evidence_store
from lab.training.data.evidence_store import load_objects, load_truths
from lab.training.data.frames import DataSet
from lab.training.evidence.grid_training import KEPT_SHARE, GridEpoch, GridSchedule, average
from lab.training.evidence.runs import CHANNELS, EVIDENCE, EVIDENCE_FILE, FIELDS_FILE, GRID, EvidenceRun, Report
from lab.training.evidence.train_evidence import EvidenceTraining
from lab.training.evidence.train_fields import FieldTraining
from lab.training.export.evidence import quantize_evidence
from lab.training.export.onnx import write_card
from lab.training.run_folder import BEST, LAST, load_state
from models.perception.cards import card_path, learned_path
from models.perception.find.detectors import NetworkDetector
from models.perception.find.onnx_model import DensePredictor
from models.perception.mirrors.peaks_to_view import GeometryParams, direct_structure
from models.perception.see.evidence_predictor import EvidencePredictor
from models.perception.see.wall_elements import WALL_ANSWERS
from msgs.files.array_files import load_arrays
from msgs.files.checksums import file_sha256
from nodes.geometry import Params, predictor_of
from sim_player.dataset.shards import Recipe
from sim_player.dataset.writer import write_dataset

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("places")
    write_dataset(folder, 3, 5, Recipe(effects="basic", truth=True))
    return folder


@pytest.fixture(scope="module")
def judges(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("judges")
    write_dataset(folder, 2, 6, Recipe(effects="basic", truth=True))
    return folder


def train(places: Path, judges: Path, work: Path, report: Report = lambda *_: None) -> Path:
    """One epoch of the field network, two of the evidence network; the folder of the exported files."""
    run = EvidenceRun(data=[places], validation=[judges], folder=work)
    run.train_fields(GridSchedule(epochs=1, batch_size=2), report)
    run.train_evidence(GridSchedule(epochs=2, batch_size=2), report)
    return work


@pytest.fixture(scope="module")
def trained(places: Path, judges: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(places, judges, tmp_path_factory.mktemp("work"))


def test_samples_hold_what_the_scans_show(places: Path, trained: Path) -> None:
    (path,) = (trained / "evidence-samples" / places.name).glob("*.npz")
    truths, objects, data = load_truths(path), load_objects(path), DataSet(places)
    assert len(truths) == len(objects) == len(data) == 3
    for index, (truth, of_scan) in enumerate(zip(truths, objects, strict=True)):
        scan = data.scan(index)
        assert truth.truth == scan.truth
        np.testing.assert_array_equal(truth.labels.range_m, scan.labels.range_m)
        for place_m, number in zip(of_scan.place_m[of_scan.asked], of_scan.number[of_scan.asked], strict=True):
            own = scan.labels.object_index == number
            assert np.hypot(*(scan.labels.hidden_xy_m[own] - place_m).T).min() < 3.0


def test_left_and_right_are_exchanged_in_evidence_and_objects_alike(
    places: Path, trained: Path, tmp_path: Path
) -> None:
    """Half of all training: what a flip asks for is what the mirrored scan with mirrored objects asks for."""
    paths = list((trained / "evidence-samples" / places.name).glob("*.npz"))
    training = EvidenceTraining(paths, [], EVIDENCE, GRID, GridSchedule(epochs=1, batch_size=2), tmp_path)
    channels = training._batch(torch.arange(training.scans))
    objects = load_objects(paths[0])
    assert any(item.asked.any() for item in objects)
    turned = channels.flip(3)
    turned[:, EVIDENCE.odd_channels] *= -1
    across = np.array([1.0, -1.0], np.float32)
    mirrored = [
        replace(item, **{name: getattr(item, name) * across for name in ("place_m", "centre_m", "heading")})
        for item in objects
    ]
    with torch.no_grad():
        flipped, _ = training._loss(channels, objects, True)
        same, _ = training._loss(turned, mirrored, False)
    assert flipped.item() == pytest.approx(same.item(), rel=1e-6)


def test_a_field_network_begins_with_the_answers_of_a_detector(places: Path, trained: Path, tmp_path: Path) -> None:
    files = sorted((trained / "fields-samples" / places.name).glob("*.npz"))
    schedule = GridSchedule(epochs=1, batch_size=2)
    training = FieldTraining(files, files, CHANNELS, GRID, schedule, tmp_path)
    detector = learned_path("compact_unet")
    training.start_from_detector(detector)
    training.network.eval()
    cells = load_arrays(files[0], only=("cells",))["cells"][:1].astype(np.float32)
    with torch.no_grad():
        answer = training.network(torch.from_numpy(cells))[0, WALL_ANSWERS:].numpy()
    wanted = DensePredictor(detector).infer(cells[0])
    np.testing.assert_allclose(expit(answer), wanted, atol=2e-3)


def test_a_run_goes_on_from_exported_networks(places: Path, judges: Path, trained: Path, tmp_path: Path) -> None:
    """Parity with both files is checked on the way; their cards say the start."""
    run = EvidenceRun(data=[places], validation=[judges], folder=tmp_path, init=trained / EVIDENCE_FILE)
    cards = [
        run.train_fields(GridSchedule(epochs=1, batch_size=2)),
        run.train_evidence(GridSchedule(epochs=1, batch_size=2)),
    ]
    assert all(card.training["start"].startswith("evidence_unet.onnx, sha256") for card in cards)
    with pytest.raises(ValueError, match="start must be a network of this shape in full precision"):
        replace(run, folder=tmp_path / "int8", init=learned_path("evidence_unet.int8")).train_fields(GridSchedule())


def test_some_training_scans_have_a_poor_map(places: Path) -> None:
    """In the share of the scans that is asked for, where the data set has it; all or none of a drive's."""
    frames = [DataSet(places).frame(0)] * 200
    numbered = [replace(frame, index=index) for index, frame in enumerate(frames)]
    maps = [evidence_store._poor_map(frame, 0) for frame in numbered]
    exact = [tuple(map(tuple, wall.ends_m)) for wall in frames[0].map_walls]
    assert exact
    with_map = [walls for walls in maps if walls]
    # binomial of 200 at 0.2: a standard deviation of 6
    assert 20 < len(with_map) < 60
    assert {len(walls) for walls in with_map} == {len(exact)}
    placed = [np.allclose(walls[0].line.ends_m, frames[0].map_walls[0].ends_m, atol=1e-6) for walls in with_map]
    # as the map has it but for a fifth, of 40: a standard deviation of 2.5
    assert 0.6 < np.mean(placed) < 1.0
    of_drive = [bool(evidence_store._poor_map(replace(frame, sequence="a"), 0)) for frame in numbered]
    assert len(set(of_drive)) == 1


def test_a_stopped_run_goes_on_to_the_same_weights(
    places: Path, judges: Path, trained: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """One epoch of two, then the rest, by samples that are there already."""
    work = tmp_path_factory.mktemp("again")
    for path in trained.glob("*-samples"):
        shutil.copytree(path, work / path.name)

    def stop(network: str, epoch: GridEpoch) -> None:
        if network == "evidence":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(places, judges, work, stop)
    train(places, judges, work)
    for network in ("fields", "evidence"):
        whole, again = (load_state(folder / network / BEST)["network"] for folder in (trained, work))
        assert all((whole[name] == again[name]).all() for name in whole)


def test_the_evidence_network_kept_is_the_average_of_its_steps(trained: Path) -> None:
    """Not that of a single step; the field network is not averaged."""
    best, last = (load_state(trained / "evidence" / name) for name in (BEST, LAST))
    averaged = {name.removeprefix("module."): weight for name, weight in last["averaged"].items()}
    apart = {name: weight for name, weight in best["network"].items() if not torch.equal(weight, last["network"][name])}
    assert apart
    if best["epoch"] == last["reports"][-1]["epoch"]:
        assert all(torch.equal(weight, averaged[name]) for name, weight in best["network"].items())
    assert load_state(trained / "fields" / LAST)["averaged"] is None


def test_an_average_keeps_half_after_ten_steps_and_no_more_than_was_set() -> None:
    """1 and 3: 2 after ten steps; after a million 1 + 2 / 1000. Counts are taken over."""
    for step, kept in ((10, 0.5), (1_000_000, KEPT_SHARE)):
        into = [torch.tensor([1.0]), torch.tensor(4)]
        average(into, [torch.tensor([3.0]), torch.tensor(7)], torch.tensor(step))
        assert into[0].item() == pytest.approx(3.0 - 2.0 * kept)
        assert into[1].item() == 7


def test_the_vehicle_judges_a_scan_by_the_exported_networks(places: Path, trained: Path) -> None:
    path = trained / EVIDENCE_FILE
    predictor = predictor_of(Params(object_network=str(path), object_threshold=0.0))
    assert isinstance(predictor, EvidencePredictor)
    data = DataSet(places)
    ra_map = data.frame(0).ra_map
    peaks = NetworkDetector(data.setup).detect(ra_map)
    _, walls = direct_structure(peaks, GeometryParams(walls=predictor.walls))
    objects = predictor.judge(ra_map, walls)()
    assert objects
    assert all(0.0 <= item.score <= 1.0 for item in objects)
    photons = msgspec.structs.replace(ra_map, mode="photons")
    with pytest.raises(ValueError, match=r"map\.mode must be of a radar for evidence_unet, got photons"):
        predictor.judge(photons, walls)


def test_networks_that_do_not_belong_together_are_refused(trained: Path, tmp_path: Path) -> None:
    for name in (EVIDENCE_FILE, FIELDS_FILE):
        for path in (trained / name, card_path(trained / name)):
            (tmp_path / path.name).write_bytes(path.read_bytes())
    other = card_path(tmp_path / EVIDENCE_FILE)
    other.write_text(other.read_text().replace(file_sha256(trained / FIELDS_FILE), "0" * 64))
    with pytest.raises(ValueError, match=r"field network must have the sha256 0{64} of its card"):
        EvidencePredictor(tmp_path / EVIDENCE_FILE)


def test_whole_numbers_answer_like_the_network_they_are_made_of(places: Path, trained: Path, tmp_path: Path) -> None:
    """Both networks, rounded on the first scan: probabilities within 0.1, cards that belong together. By a field
    network that is rounded already the evidence network is the same.
    """
    card = quantize_evidence(trained / EVIDENCE_FILE, DataSet(places), 1, tmp_path / "evidence_unet.int8.onnx")
    assert card.scores["largest_probability_difference"] < 0.1
    assert card.data["fields"] == "field_unet.int8.onnx"
    assert EvidencePredictor(tmp_path / "evidence_unet.int8.onnx").card == card
    source = shutil.copy(trained / EVIDENCE_FILE, tmp_path)
    exact = EvidencePredictor(trained / EVIDENCE_FILE).card
    names = {name: card.data[name] for name in ("fields", "fields_sha256")}
    write_card(msgspec.structs.replace(exact, data={**exact.data, **names}), Path(source))
    assert quantize_evidence(Path(source), DataSet(places), 1, tmp_path / "again.onnx").sha256 == card.sha256
    assert not (tmp_path / "field_unet.int8.int8.onnx").exists()


def test_validation_places_are_not_trained_on(places: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no scan may share a place with"):
        EvidenceRun(data=[places], validation=[places], folder=tmp_path)
