from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import torch

from lab.networks.compact_unet import CompactUNetConfig
from lab.training.data.samples import DataConfig
from lab.training.export import onnx as export_onnx
from lab.training.export.onnx import PARITY, ExportConfig, export_run
from lab.training.map_networks import NetworkChoice
from lab.training.run_folder import BEST, CONFIG, SUMMARY
from lab.training.train_dense import EpochReport, RunConfig, RunSummary, TrainDenseConfig
from models.perception.find.encoding import Encoding
from models.perception.find.onnx_model import DensePredictor, load_card
from models.perception.find.pursuit import pursued_peaks
from models.physics.antenna import setup_weights, two_way_pattern
from models.physics.waveform import range_profile
from msgs.values.radar import RadarSetup, RangeAzimuthGrid

GRID = RangeAzimuthGrid(range_bins=48, azimuth_bins=128)
ENCODING = Encoding(range_bins=32, columns=16)
#: Chosen on the validation scenes.
THRESHOLD = 0.2
NETWORK = CompactUNetConfig(range_bins=32, columns=16, widths=(8, 16), attention_heads=2, attention_blocks=1)


def write_shards(directory: Path, seed: int, scenes: int = 12) -> Path:
    """A data set of one strong direct return a scene, in two shards, as the simulator writes them."""
    setup = RadarSetup()
    rng = np.random.default_rng(seed)
    range_m, azimuth_rad = rng.uniform(1.0, 6.0, scenes), np.radians(rng.uniform(-50.0, 50.0, scenes))
    pattern = two_way_pattern(setup, setup_weights(setup), azimuth_rad, np.zeros(scenes))
    echo = range_profile(setup.radar, 2.0 * range_m, GRID.range_bins)
    profiles = 1e-5 * (pattern.T[:, :, None] * echo[:, None]).astype(np.complex64)
    directory.mkdir()
    for shard, selected in enumerate(np.split(np.arange(scenes), 2)):
        np.savez(
            directory / f"shard-{shard:05d}.npz",
            profiles=profiles[selected],
            noise_power_mw=np.full(len(selected), 1e-13),
            offset=np.arange(len(selected) + 1),
            range_m=range_m[selected].astype(np.float32),
            azimuth_rad=azimuth_rad[selected].astype(np.float32),
            path_class=np.zeros(len(selected), np.uint8),
        )
    (directory / "series.json").write_bytes(msgspec.json.encode({"seed": seed, "grid": msgspec.to_builtins(GRID)}))
    (directory / "manifest.jsonl").write_bytes(b'{"scenes": %d}\n' % scenes)
    return directory


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    return write_shards(tmp_path / "data", seed=1)


@pytest.fixture
def run_dir(tmp_path: Path, data_dir: Path) -> Path:
    """A run folder as training leaves it, of a network that learned nothing: half of what it sees is over 0.1."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    choice = NetworkChoice(family="compact_unet", config=asdict(NETWORK))
    data = DataConfig(directory=str(data_dir), encoding=ENCODING, grid=GRID)
    run = RunConfig(training=TrainDenseConfig(network=choice, seed=5), data=data)
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / CONFIG).write_bytes(msgspec.json.encode(run))
    torch.save({"network": choice.build().state_dict(), "epoch": 3}, folder / BEST)
    best = EpochReport(
        epoch=3,
        train_loss=1.0,
        validation_loss=1.0,
        macro_f1=0.5,
        los_f1=0.5,
        mirrored_f1=0.5,
        best_threshold=THRESHOLD,
        best_macro_f1=0.6,
        is_best=True,
    )
    summary = RunSummary(
        family="compact_unet", parameters=1, scenes=8, epochs=4, sample_steps=32, best=best, unconverged=True
    )
    (folder / SUMMARY).write_bytes(msgspec.json.encode(summary))
    return folder


def test_export_writes_a_model_that_its_card_describes(run_dir: Path, data_dir: Path, tmp_path: Path) -> None:
    model = tmp_path / "net.onnx"
    card = export_run(run_dir, model, ExportConfig())
    assert load_card(model) == card
    assert card.threshold == THRESHOLD
    assert DensePredictor(model).card.grid == GRID
    assert (card.name, card.network, card.precision, card.head) == ("net", "compact_unet", "fp32", "heatmap")
    assert card.fidelity is not None
    assert card.fidelity.largest_difference <= PARITY
    assert (card.fidelity.lost_points, card.fidelity.calibration_maps) == (0.0, 0)
    made = f"mirrorwave sim dataset --out {data_dir} --count 12 --seed 1"
    assert card.data["training"] == made
    assert (card.data["test"], card.data["test_scenes"]) == ("its test split", 2)
    assert card.threshold in [line.threshold for line in card.scores]
    assert card.pursuit_threshold in export_onnx.PURSUIT_THRESHOLDS
    assert card.threshold_for("pursuit") == card.pursuit_threshold
    assert card.threshold_for("none") == THRESHOLD
    assert card.training["command"].startswith(f"mirrorwave train dense --data {data_dir} --out {run_dir}")
    assert (card.training["chosen_epoch"], card.training["config"]["training"]["seed"]) == (3, 5)


def test_peaks_by_pursuit_have_a_threshold_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two returns with a confidence of about 0.4, and in each class a false hill of half of that: it falls between."""
    rows, columns = np.array([12, 30]), np.array([20, 44])
    hill = np.exp(-0.5 * np.add.outer(((np.arange(48) - 40) / 1.5) ** 2, ((np.arange(64) - 8) / 2.5) ** 2))
    heatmap = 0.25 * np.stack([hill, hill])
    for path_class, (row, column) in enumerate(zip(rows, columns, strict=True)):
        heatmap[path_class] += 0.5 * np.roll(hill, (row - 40, column - 8), (0, 1))

    class Predictor:
        card = SimpleNamespace(grid=GRID)

        def __init__(self, path: Path) -> None:
            pass

        def predict(self, ra_map: object) -> np.ndarray:
            return heatmap

    labels = SimpleNamespace(
        range_m=GRID.range_at(rows), azimuth_rad=GRID.azimuth_at(columns), path_class=np.array([0, 1], np.uint8)
    )
    monkeypatch.setattr(export_onnx, "DensePredictor", Predictor)
    frame = SimpleNamespace(ra_map=SimpleNamespace(grid=GRID), labels=labels)
    threshold = export_onnx.best_pursuit_threshold(Path(), [frame])  # type: ignore[list-item]
    false = pursued_peaks(0.25 * hill, 0.05)[1][0]
    assert false < threshold <= false + 0.02


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["fp16", "int8"])
def test_smaller_numbers_say_what_they_cost(run_dir: Path, tmp_path: Path, precision: str) -> None:
    """A thousandth of a probability for 11 bits, a few hundredths for 8; the card tells both."""
    model = tmp_path / "small.onnx"
    card = export_run(run_dir, model, ExportConfig(precision=precision, calibration_maps=4))  # type: ignore[arg-type]
    assert DensePredictor(model).card.precision == precision
    assert card.fidelity is not None
    assert 1e-6 < card.fidelity.largest_difference < {"fp16": 1e-2, "int8": 1e-1}[precision]
    assert card.fidelity.calibration_maps == (4 if precision == "int8" else 0)
    own = next(line.macro_f1 for line in card.scores if line.threshold == card.threshold)
    assert card.fidelity.lost_points == pytest.approx(100.0 * (card.fidelity.macro_f1_fp32 - own), abs=0.02)


def test_export_needs_to_know_how_the_data_was_made(run_dir: Path, data_dir: Path, tmp_path: Path) -> None:
    (data_dir / "manifest.jsonl").unlink()
    with pytest.raises(ValueError, match=r"data must hold a whole data set: .*manifest\.jsonl"):
        export_run(run_dir, tmp_path / "net.onnx", ExportConfig())
    assert not (tmp_path / "net.onnx").exists()


def test_a_card_names_the_command_of_drives(tmp_path: Path) -> None:
    """24 scans in the manifest are two drives of 12."""
    series = {"places": "any", "preset": "xband", "effects": "all", "seed": 7, "motion": True, "scans": 12}
    (tmp_path / "series.json").write_bytes(msgspec.json.encode(series))
    (tmp_path / "manifest.jsonl").write_text('{"shard": "shard-00000.npz", "scenes": 24}\n')
    command = f"mirrorwave sim dataset --out {tmp_path} --count 2 --seed 7 --motion --scans 12 --places any"
    assert export_onnx._command(tmp_path).startswith(command)


def test_a_card_names_the_purpose_of_a_series(tmp_path: Path) -> None:
    series = {"places": "any", "effects": "auto", "budget_db": -20.0, "purpose": "peaks", "seed": 7}
    (tmp_path / "series.json").write_bytes(msgspec.json.encode(series))
    (tmp_path / "manifest.jsonl").write_text('{"shard": "shard-00000.npz", "scenes": 2}\n')
    assert export_onnx._command(tmp_path).endswith("--places any --effects auto --budget-db -20.0 --for peaks")
