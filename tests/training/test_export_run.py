from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from models.networks.compact_unet import CompactUNetConfig
from models.perception.encoding import Encoding
from models.perception.onnx_model import DensePredictor, load_card
from models.physics.antenna import setup_weights, two_way_pattern
from models.physics.waveform import range_profile
from models.training.datasets import DataConfig, load_samples, load_training_data, read_scans
from models.training.export_onnx import export_run
from models.training.train_dense import DenseTraining, TrainDenseConfig
from msgs.radar import RadarSetup, RangeAzimuthGrid

GRID = RangeAzimuthGrid(range_bins=48, azimuth_bins=64)
DATA = DataConfig(encoding=Encoding(range_bins=32, columns=8), grid=GRID, validation_share=0.25)
NETWORK = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 16), attention_heads=2, attention_blocks=1)


def write_shards(directory: Path, seed: int, scenes: int = 8) -> Path:
    """A data set of one strong direct return a scene, in two shards, as the simulator writes them."""
    setup = RadarSetup()
    rng = np.random.default_rng(seed)
    range_m, azimuth_rad = rng.uniform(1.0, 6.0, scenes), np.radians(rng.uniform(-50.0, 50.0, scenes))
    pattern = two_way_pattern(setup, setup_weights(setup), azimuth_rad, np.zeros(scenes))
    echo = range_profile(setup.radar, 2.0 * range_m, GRID.range_bins)
    profiles = 1e-5 * (pattern.T[:, :, None] * echo[:, None]).astype(np.complex64)
    directory.mkdir()
    for shard, chosen in enumerate(np.split(np.arange(scenes), 2)):
        np.savez(
            directory / f"shard-{shard:05d}.npz",
            profiles=profiles[chosen],
            noise_power_mw=np.full(len(chosen), 1e-13),
            offset=np.arange(len(chosen) + 1),
            range_m=range_m[chosen].astype(np.float32),
            azimuth_rad=azimuth_rad[chosen].astype(np.float32),
            path_class=np.zeros(len(chosen), np.uint8),
        )
    (directory / "series.json").write_bytes(msgspec.json.encode({"seed": seed}))
    (directory / "manifest.jsonl").write_bytes(b'{"scenes": %d}\n' % scenes)
    return directory


@pytest.fixture
def train_dir(tmp_path: Path) -> Path:
    return write_shards(tmp_path / "train", seed=1)


def test_truth_lies_where_the_map_peaks(train_dir: Path) -> None:
    """Layout: one scatterer a scene. The map peaks in its cell, to the rounding and, towards the sides, the slope of
    the element pattern within the beam: 1 bin in range, 3 deg = 1.6 cells of this grid and its rounding in azimuth.
    """
    config = replace(DATA, encoding=Encoding(range_bins=48, columns=32))
    for sample in load_samples(train_dir, config):
        row, column = np.unravel_index(np.abs(sample.columns).argmax(), sample.columns.shape)
        assert abs(row - sample.labels.row[0]) <= 1.0
        # column j of 32 is centred on azimuths 2 j + 0.5
        assert abs(2 * column + 0.5 - sample.labels.column[0]) <= 3.0


def test_scenes_are_split_and_varied(train_dir: Path) -> None:
    data = load_training_data(train_dir, replace(DATA, perturbed_copies=2))
    assert len(data.train) == 6
    assert len(data.validation) == 2
    assert all(len(variants) == 3 for variants in data.train)
    again = load_training_data(train_dir, replace(DATA, perturbed_copies=2))
    np.testing.assert_array_equal(data.train[0][1].columns, again.train[0][1].columns)
    assert (data.train[0][0].columns != data.train[0][1].columns).any()


def test_folder_without_a_data_set_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must hold shards \(shard-\*\.npz\), found none"):
        read_scans(tmp_path, GRID)
    np.savez(tmp_path / "shard-00000.npz", profiles=np.zeros(1))
    with pytest.raises(ValueError, match=r"shard-00000\.npz must hold the arrays .* it lacks noise_power_mw, offset"):
        read_scans(tmp_path, GRID)


def test_export_writes_a_model_that_its_card_describes(train_dir: Path, tmp_path: Path) -> None:
    test_dir = write_shards(tmp_path / "test", seed=2)
    config = TrainDenseConfig(epochs=1, batch_size=4, network=NETWORK, mixed_precision=False)
    DenseTraining(config, load_training_data(train_dir, DATA), tmp_path / "run").run(lambda report: None)
    model = tmp_path / "net.onnx"
    card = export_run(tmp_path / "run", test_dir, model, train_dir)
    assert load_card(model) == card
    assert DensePredictor(model).card.grid == GRID
    # a folder that names no recipe holds the first generator's streets
    recipe = "--places street_v1"
    assert card.data["training"] == f"mirrorwave sim dataset --out {train_dir} --count 8 --seed 1 {recipe}"
    assert card.data["test"] == f"mirrorwave sim dataset --out {test_dir} --count 8 --seed 2 {recipe}"
    assert card.threshold in [line.threshold for line in card.scores]
    assert card.training["config"]["training"]["network"]["widths"] == [8, 16]


def test_export_needs_to_know_how_the_data_was_made(train_dir: Path, tmp_path: Path) -> None:
    config = TrainDenseConfig(epochs=1, batch_size=4, network=NETWORK, mixed_precision=False)
    DenseTraining(config, load_training_data(train_dir, DATA), tmp_path / "run").run(lambda report: None)
    (train_dir / "series.json").unlink()
    with pytest.raises(ValueError, match=r"train must hold a whole data set: .*series\.json"):
        export_run(tmp_path / "run", train_dir, tmp_path / "net.onnx", train_dir)
