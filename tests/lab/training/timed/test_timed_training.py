"""Arrays made once from shards, batches on the device, and a run by the clock, from shards to an exported file."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.accuracy.full_size import tiny
from lab.training.data.map_arrays import ArrayMaker, MapArrays, View
from lab.training.data.samples import DataConfig
from lab.training.export.onnx import export_scored
from lab.training.map_networks import FAMILIES, INPUTS, choice_of, preset_network
from lab.training.objectives.heatmaps import class_heatmaps, class_masks
from lab.training.run_folder import save_state
from lab.training.schedules import ScheduleConfig
from lab.training.timed.batches import encode, heatmaps, masks, point_table
from lab.training.timed.packed_runs import PACKED, packed, read_parts, unpacked, write_parts
from lab.training.timed.training import TimedTraining
from lab.training.train_dense import RunConfig, TrainDenseConfig, load_best, load_summary
from models.perception.find.encoding import Encoding, encode_columns, sample_columns
from models.perception.find.onnx_model import DensePredictor
from msgs.values.radar import RadarSetup

FULL, NARROW = View(512, 256), View(320, 32)
DEVICE = torch.device("cpu")


@pytest.fixture(scope="module")
def arrays(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Arrays of five maps with a point each, in both views."""
    folder, rng = tmp_path_factory.mktemp("maps"), np.random.default_rng(3)
    values = 1e-6 * rng.standard_normal((5, 512, 256, 2)) @ (1.0, 1.0j)
    values[:, 100, 60] += 1e-3
    values[1] = 0.0
    np.savez(
        folder / "shard-00000.npz",
        values=values.astype(np.complex64),
        noise_power_mw=np.full(5, 2e-12),
        offset=np.arange(6),
        range_m=np.full(5, 100 * 0.21413747),
        azimuth_rad=np.full(5, -0.5),
        path_class=np.array([0, 1, 0, 1, 0]),
    )
    maker = ArrayMaker(DataConfig(), (FULL, NARROW), 1, RadarSetup())
    assert maker.make(folder / "shard-00000.npz", folder) == 5
    assert maker.make(folder / "shard-00000.npz", folder) == 0
    np.save(folder / "values.npy", values.astype(np.complex64))
    return folder


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("view", [FULL, NARROW])
def test_the_device_encodes_as_the_vehicle_does(arrays: Path, name: str, view: View) -> None:
    encoding = Encoding(range_bins=view.range_bins, columns=view.columns, channels=INPUTS[name])
    maps = MapArrays([arrays], view).take(np.arange(5))
    got = encode(encoding, torch.from_numpy(maps.values).float(), torch.from_numpy(maps.noise)).numpy()
    columns = sample_columns(encoding, np.load(arrays / "values.npy"))
    expected = encode_columns(encoding, columns, np.full(5, 2e-12))
    assert np.abs(got - expected).max() < 1e-3 * max(1.0, np.abs(expected).max())


def test_targets_on_the_device_are_those_of_the_processor(arrays: Path) -> None:
    labels = MapArrays([arrays], NARROW).take([0, 1, 2]).labels
    edge = replace(labels[0], row=np.array([0.0, 319.4, 320.6]), column=np.array([255.0, 3.0, 8.0]))
    labels = [replace(edge, path_class=np.array([0, 1, 0])), *labels[1:]]
    shape, points = (3, 2, 320, 256), torch.from_numpy(point_table(labels))
    arguments = [(shape[2:], one.row, one.column, one.path_class) for one in labels]
    assert np.allclose(heatmaps(points, shape, 1.0), np.stack([class_heatmaps(*one) for one in arguments]), atol=1e-7)
    assert np.array_equal(masks(points, shape), np.stack([class_masks(*one) for one in arguments]))


@pytest.mark.parametrize("network", ["compact_unet:compact", "radar_tensor_network:compact"])
def test_a_run_by_the_clock_goes_on_and_is_packed_and_exported(arrays: Path, tmp_path: Path, network: str) -> None:
    family, size = network.split(":")
    choice, encoding = preset_network(family, size)
    schedule = ScheduleConfig(batch_size=2, epochs=1, minutes=2.0 / 60.0)
    training = TrainDenseConfig(
        network=choice_of(family, tiny(choice.resolved)),
        objective=FAMILIES[family].objective,
        schedule=schedule,
        mixed_precision=False,
    )
    config = RunConfig(training=training, data=DataConfig(encoding=encoding), command="python -m this")
    view = NARROW if View.of(encoding) == NARROW else FULL
    maps, run_dir = MapArrays([arrays], view, encoding.range_bins), tmp_path / "run"
    first = TimedTraining(config, maps, run_dir, DEVICE)
    first.run(time.monotonic() + 0.8)
    assert first.optimiser.param_groups[0]["lr"] < schedule.learning_rate
    first.save()
    second = TimedTraining(config, maps, run_dir, DEVICE)
    assert second.progress == first.progress
    second.run(time.monotonic() + 0.5)
    _, tally = second.finish(maps, np.arange(5))
    assert second.is_done
    assert second.samples == load_summary(run_dir).sample_steps
    card = export_scored(run_dir, tmp_path / "network.onnx", tally)
    assert card.training["command"] == "python -m this"
    assert len(card.scores) == len(tally.counts)
    DensePredictor(tmp_path / "network.onnx")
    save_state(run_dir / PACKED, {"network": packed(second.network.state_dict(), "int8"), "epoch": 1})
    (tmp_path / "parts").mkdir()
    parts = write_parts([run_dir], tmp_path / "parts")
    (unpacked_dir,) = read_parts(tmp_path / "parts", tmp_path / "back")
    network_back, found, _ = load_best(unpacked_dir)
    assert len(parts) == 1
    assert found == config
    for name, tensor in second.network.state_dict().items():
        assert (network_back.state_dict()[name] - tensor).abs().max() <= 0.01 * tensor.abs().max()


def test_bad_parts_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must hold parts"):
        read_parts(tmp_path, tmp_path)
    (tmp_path / "runs.tar.0").write_bytes(b"none")
    with pytest.raises(ValueError, match="one whole archive"):
        read_parts(tmp_path, tmp_path)


def test_int8_weights_are_near_the_first() -> None:
    state = {"weight": torch.randn(64, 128), "bias": torch.randn(64), "count": torch.tensor(3)}
    back = unpacked(packed(state, "int8"))
    assert back["weight"].dtype == torch.float32
    assert torch.equal(back["bias"], state["bias"])
    assert ((back["weight"] - state["weight"]).abs() / state["weight"].abs().amax(1, keepdim=True)).max() < 0.5 / 126
