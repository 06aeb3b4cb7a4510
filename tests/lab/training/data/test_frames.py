from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from lab.training.data.frames import DataSet, Splits, fixed_splits
from msgs.values.radar import PRESETS, RangeAzimuthGrid
from sim_player.dataset.writer import write_dataset

GRID = RangeAzimuthGrid(range_bins=16, azimuth_bins=8)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_dataset(folder, count=10, seed=1)
    return folder


def write_maps(folder: Path, sequences: list[str], **changes: np.ndarray) -> None:
    """A folder of maps made elsewhere, one truth point each."""
    count = len(sequences)
    rng = np.random.default_rng(3)
    values = (rng.standard_normal((count, *GRID.shape, 2)) @ (1.0, 1.0j)).astype(np.complex64)
    arrays = {
        "values": values,
        "noise_power_mw": np.ones(count),
        "offset": np.arange(count + 1),
        "range_m": np.ones(count),
        "azimuth_rad": np.zeros(count),
        "path_class": np.zeros(count, np.uint8),
        "sequence": np.array(sequences),
    }
    folder.mkdir(exist_ok=True)
    np.savez(folder / "shard-00000.npz", **arrays | changes)
    grid = msgspec.to_builtins(GRID)
    (folder / "series.json").write_bytes(msgspec.json.encode({"format": "maps", "grid": grid}))


@pytest.mark.slow
def test_simulated_frames_are_formed_as_on_the_vehicle(simulated: Path) -> None:
    data = DataSet(simulated)
    assert len(data) == 10
    frame = data.frame(3)
    assert frame.ra_map.grid == RangeAzimuthGrid()
    assert frame.ra_map.scan_id == frame.index == 3
    assert len(frame.labels) > 0
    assert frame.place
    assert frame.relays
    assert frame.scene_yaml
    strongest = np.abs(frame.ra_map.values).max()
    assert strongest**2 > 100.0 * frame.ra_map.noise_power_mw


def test_splits_are_fixed_disjoint_and_complete(simulated: Path) -> None:
    splits = fixed_splits(simulated)
    assert (len(splits.train), len(splits.validation), len(splits.test)) == (7, 1, 2)
    assert splits.of("all").tolist() == list(range(10))
    assert fixed_splits(simulated) == splits
    with pytest.raises(ValueError, match="split must be train, validation, test or all, got 'dev'"):
        splits.of("dev")


def test_published_count_splits_as_published() -> None:
    last = np.rint(np.cumsum((0.70, 0.15, 0.15)) * 2160)
    assert np.diff(last, prepend=0).tolist() == [1512, 324, 324]


def test_a_leaking_split_is_refused_by_scene(simulated: Path) -> None:
    path = simulated / "splits.json"
    kept = path.read_bytes() if path.exists() else b""
    splits = fixed_splits(simulated)
    try:
        leaking = msgspec.structs.replace(splits, validation=[splits.train[0]])
        path.write_bytes(msgspec.json.encode(leaking))
        with pytest.raises(ValueError, match="train and validation must share no scene"):
            fixed_splits(simulated)
        path.write_bytes(msgspec.json.encode(msgspec.structs.replace(splits, test_sha256="0" * 64)))
        with pytest.raises(ValueError, match="test_sha256 must be 000"):
            fixed_splits(simulated)
        path.write_bytes(msgspec.json.encode(msgspec.structs.replace(splits, test=splits.test[:1])))
        with pytest.raises(ValueError, match="must name each of 10 scenes once, names 9"):
            fixed_splits(simulated)
        path.write_bytes(b"{")
        with pytest.raises(ValueError, match=r"splits\.json: "):
            fixed_splits(simulated)
    finally:
        path.write_bytes(kept or msgspec.json.encode(splits))


def test_a_sequence_is_never_cut(tmp_path: Path) -> None:
    """Five drives of four captures: whole drives go to one split; a split that cuts one is refused by its name."""
    write_maps(tmp_path, [f"drive {index // 4}" for index in range(20)])
    splits = fixed_splits(tmp_path)
    drives = [{int(index) // 4 for index in splits.of(name)} for name in ("train", "validation", "test")]
    assert all(drives)
    assert sum(len(part) for part in drives) == 5
    moved = splits.test[0]
    cut = Splits(
        seed=0,
        train=sorted([*splits.train, moved]),
        validation=splits.validation,
        test=splits.test[1:],
        test_sha256=splits.test_sha256,
    )
    (tmp_path / "splits.json").write_bytes(msgspec.json.encode(cut))
    with pytest.raises(ValueError, match=r"train and test must share no scene.*drive"):
        fixed_splits(tmp_path)


def test_maps_made_elsewhere_are_taken_as_they_are(tmp_path: Path) -> None:
    write_maps(tmp_path, ["a", "b"])
    frame = DataSet(tmp_path).frame(1)
    assert frame.ra_map.grid == GRID
    assert not frame.ra_map.incoherent.any()
    assert np.isnan(frame.labels.hidden_xy_m).all()
    power = np.ones((2, *GRID.shape), np.complex64)
    write_maps(tmp_path, ["a", "b"], values=power)
    assert DataSet(tmp_path).frame(0).ra_map.incoherent.all()


def test_what_is_no_data_set_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must hold shards"):
        DataSet(tmp_path)
    (tmp_path / "shard-00000.npz").write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=r"shard-00000\.npz must be a shard"):
        DataSet(tmp_path)
    np.savez(tmp_path / "shard-00000.npz", offset=np.zeros(1))
    with pytest.raises(ValueError, match="it lacks noise_power_mw, range_m, azimuth_rad, path_class, profiles"):
        DataSet(tmp_path)


def test_values_that_are_not_finite_name_their_scene(tmp_path: Path) -> None:
    values = np.ones((2, *GRID.shape), np.complex64)
    values[1, 0, 0] = np.nan
    write_maps(tmp_path, ["a", "b"], values=values)
    with pytest.raises(ValueError, match="values of scene 1 must be finite"):
        DataSet(tmp_path).scan(1)


def test_data_know_their_radar(tmp_path: Path) -> None:
    write_maps(tmp_path, ["a", "b", "c"])
    (tmp_path / "series.json").write_text('{"preset": "77ghz"}')
    assert DataSet(tmp_path).setup is PRESETS["77ghz"]
    (tmp_path / "series.json").write_text('{"preset": "spad"}')
    with pytest.raises(ValueError, match=r"series\.json: preset must be one of xband, 77ghz, got 'spad'"):
        DataSet(tmp_path)


@pytest.mark.parametrize("written", ["6", "0", '"other"', "null", "[5]"])
def test_a_set_of_another_version_is_refused(written: str, tmp_path: Path) -> None:
    write_maps(tmp_path, ["a", "b", "c"])
    (tmp_path / "series.json").write_text(f'{{"format": {written}}}')
    with pytest.raises(ValueError, match=r"series\.json: this version reads formats 1\.\.5 and 'maps', got "):
        DataSet(tmp_path)
