from __future__ import annotations

import contextlib
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from lab.commands.export import export
from lab.commands.train import dense
from lab.commands.train_probabilities import probabilities
from lab.training.data.frames import fixed_splits
from lab.training.data.xradarnlos import POINTS_FOLDER, REAL_RANGE_M, SPECTRUM, grid_of, import_folder
from lab.training.train_dense import load_best
from models.perception.cards import card_path, read_card
from models.perception.find.onnx_model import DensePredictor
from models.perception.see.evidence_predictor import DEFAULT_EVIDENCE, EvidenceCard, EvidencePredictor
from sim_player.dataset.shards import Recipe
from sim_player.dataset.writer import write_dataset


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six scenes and one epoch."""
    folder, said = tmp_path_factory.mktemp("simulated"), io.StringIO()
    write_dataset(folder / "data", count=6, seed=1)
    with contextlib.redirect_stdout(said):
        dense(folder / "data", folder / "run", inputs="log", epochs=1, batch_size=4, seed=3, threads=1)
    assert "best Macro-F1 0." in said.getvalue()
    return folder / "run"


@pytest.mark.slow
def test_from_data_set_to_a_model_that_loads(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The verbs fit together, and what they leave loads on the vehicle's side."""
    model = tmp_path / "net.onnx"
    export(run, model, precision="int8", as_json=True)
    printed = json.loads(capsys.readouterr().out)
    card = DensePredictor(model).card
    assert printed["sha256"] == card.sha256
    assert (card.precision, printed["precision"]) == ("int8", "int8")
    assert card.data["test_scenes"] == 1
    assert card.training["config"]["training"]["seed"] == 3


def write_capture(folder: Path, seed: int) -> None:
    """One real capture as published: a bright direct cell 27.7 m away and an image behind it, others noise."""
    (folder / POINTS_FOLDER).mkdir(parents=True)
    rng = np.random.default_rng(seed)
    power = rng.exponential(1.0, (512, 256))
    power[300, 40] = power[380, 60] = 1e4
    np.savez(folder / SPECTRUM, Pxx=power)
    range_m, azimuth_rad = np.linspace(*REAL_RANGE_M, 512), np.radians(np.linspace(-60.0, 60.0, 256))
    for name, (row, column) in {"los": (300, 40), "mirrored_nlos": (380, 60), "nlos": (250, 200)}.items():
        at = range_m[row] * np.array([[np.sin(-azimuth_rad[column]), np.cos(azimuth_rad[column])]])
        np.save(folder / POINTS_FOLDER / f"{name}.npy", at)


@pytest.mark.slow
def test_fine_tuning_on_real_captures_by_sequence(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """After a simulated run the released fine-tuning from its weights on four drives of two captures: whole drives are
    held out, the backbone hardly moves (5e-6), the head ten times as fast, and the result exports on the real grid."""
    for drive, capture in np.ndindex(4, 2):
        write_capture(tmp_path / "captures" / f"drive_{drive}" / f"capture_{capture}", 2 * drive + capture)
    import_folder(tmp_path / "captures", tmp_path / "real", "real")
    arguments = {"inputs": "log", "schedule": "fine_tuning", "epochs": 1, "init": run / "best.pt"}
    dense(tmp_path / "real", tmp_path / "tuned", **arguments)  # type: ignore[arg-type]
    splits = fixed_splits(tmp_path / "real")
    assert sorted(len(splits.of(name)) for name in ("train", "validation", "test")) == [2, 2, 4]
    before, after = (load_best(folder)[0].state_dict() for folder in (run, tmp_path / "tuned"))
    moved = {name: (after[name] - before[name]).abs().max().item() for name in ("head.weight", "context.position")}
    assert 0.0 < moved["context.position"] < 1.5e-5 < moved["head.weight"] < 1.5e-4
    export(tmp_path / "tuned", tmp_path / "tuned.onnx", as_json=True)
    assert DensePredictor(tmp_path / "tuned.onnx").card.grid == grid_of("real")
    capsys.readouterr()


@pytest.mark.slow
def test_tables_of_a_shipped_network_are_fitted_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Eight scenes: another table, threshold and scores in its card, the same bytes the second time, and it loads."""
    write_dataset(tmp_path / "data", 8, 5, Recipe(effects="basic", truth=True))
    network = tmp_path / DEFAULT_EVIDENCE.name
    data = read_card(card_path(DEFAULT_EVIDENCE), EvidenceCard).data
    for path in (DEFAULT_EVIDENCE, *(DEFAULT_EVIDENCE.with_name(data[kind]) for kind in ("fields", "candidates"))):
        for item in (path, card_path(path)):
            shutil.copyfile(item, tmp_path / item.name)
    shipped = read_card(card_path(network), EvidenceCard)
    probabilities(network, [tmp_path / "data"], tmp_path / "run")
    card, written = EvidencePredictor(network).card, card_path(network).read_bytes()
    assert f"{network}: least loss {card.scores['loss_per_scan']:.3f} a scan from {card.threshold:g}" in (
        capsys.readouterr().out
    )
    assert card.scores["scans"] == 8.0
    assert card.calibration != shipped.calibration
    assert (card.calibration_moving, card.sha256) == ((), shipped.sha256), "nothing moved, and the network is the same"
    assert card.training["probabilities"]["command"].startswith(f"mirrorwave train probabilities {network} --valid")
    probabilities(network, [tmp_path / "data"], tmp_path / "run")
    assert card_path(network).read_bytes() == written


@pytest.mark.parametrize(("precision", "data"), [("fp32", Path("data")), ("int8", None)])
def test_an_exported_network_is_exported_again_in_whole_numbers_alone(precision: str, data: Path | None) -> None:
    with pytest.raises(ValueError, match=r"\.onnx: an exported network takes --precision int8 and --data"):
        export(DEFAULT_EVIDENCE, Path("out.onnx"), data=data, precision=precision)  # type: ignore[arg-type]
