"""Hard cases of data sets, run folders and exports: broken, half written, empty, in steps too small to write down."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from lab.training.calibration import fit_table
from lab.training.data.frames import DataSet, Splits, fixed_splits
from lab.training.export.onnx import require_onnx
from lab.training.run_folder import BEST, CONFIG, load_config, load_state
from models.perception.find.score_calibration import check_table

SHARD = {
    "values": np.ones((3, 512, 256), np.complex64),
    "noise_power_mw": np.ones(3),
    "offset": np.arange(4),
    "range_m": np.array([10.0, 20.0, 30.0]),
    "azimuth_rad": np.zeros(3),
    "path_class": np.zeros(3, np.uint8),
}


def data_set(folder: Path, **changes: np.ndarray) -> DataSet:
    np.savez(folder / "shard-00000.npz", **(SHARD | changes))
    return DataSet(folder)


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"range_m": np.array([10.0, np.nan, 30.0])}, "range_m must be finite, index 1 is not"),
        ({"noise_power_mw": np.array([1.0, 1.0, np.inf])}, "noise_power_mw must be finite, index 2 is not"),
        ({"path_class": np.array([0, 1, 7], np.uint8)}, "path_class must be 0 .* got 7"),
        ({"values": SHARD["values"][:2]}, "values must have length 3, got 2"),
        ({"offset": np.array([0, 2, 1, 3])}, "offset must rise from 0 to 3 points over 3 scenes"),
    ],
)
def test_a_shard_that_does_not_fit_together_is_named(tmp_path: Path, changes: dict[str, np.ndarray], rule: str) -> None:
    data = data_set(tmp_path, **changes)
    with pytest.raises(ValueError, match=rf"shard-00000\.npz: {rule}"):
        data.scan(0)


def test_an_empty_split_is_refused(tmp_path: Path) -> None:
    data_set(tmp_path)
    splits = Splits(seed=0, train=[0, 1], validation=[2], test=[], test_sha256="")
    (tmp_path / "splits.json").write_bytes(msgspec.json.encode(splits))
    with pytest.raises(ValueError, match=r"splits\.json: test must hold at least one scene, holds none"):
        fixed_splits(tmp_path)


def test_broken_run_folders_name_their_file(tmp_path: Path) -> None:
    for name in (CONFIG, BEST):
        (tmp_path / name).write_text("{")
    with pytest.raises(ValueError, match=r"config\.json: "):
        load_config(tmp_path, dict)
    with pytest.raises(ValueError, match=r"best\.pt must be a checkpoint of tensors only"):
        load_state(tmp_path / BEST)


def test_shares_that_are_written_alike_are_one_knot() -> None:
    """Two groups of 1.5 million peaks with none and one true: shares 6.7e-7 and 1.3e-6 are both written 1e-6."""
    score = np.linspace(0.1, 0.9, 3_000_003)
    is_true = np.zeros(len(score), bool)
    is_true[-1] = True
    table = fit_table(score, is_true, groups=2)
    assert len(table) == 3
    check_table("table", table)


def test_a_model_file_keeps_its_name_from_its_card() -> None:
    with pytest.raises(ValueError, match=r"net\.json must end with \.onnx"):
        require_onnx(Path("net.json"))
