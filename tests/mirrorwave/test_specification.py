"""Profile `specification`: the published system from raw beams, its table, and what its files must be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

import lab.evaluate.specification_table as table
from lab.evaluate.labelled_beams import LabelledPlace
from lab.networks.residual_reflect_net import ResidualReflectNet
from lab.networks.swin_unet import SwinUNetConfig
from lab.tradeoff.rows import profile_setting, read_settings
from lab.training.export.onnx import Exported, export_onnx, write_card
from lab.training.export.residual import export_residual_onnx
from lab.training.map_networks import choice_of
from mirrorwave.api import Perception
from mirrorwave.cli import main
from mirrorwave.profiles import PROFILES, profile_names, read_profile
from models.perception import cards
from models.perception.find.encoding import COMPLEX, Encoding, encode_map
from models.perception.find.onnx_model import DensePredictor, ModelCard
from models.perception.find.peaks import PeakParams, find_peaks
from models.perception.mirrors.peaks_to_view import GeometryParams, fold_scan
from models.perception.mirrors.residual_model import LearnedResidual, ResidualCard
from msgs.files.shipped import WEIGHTS
from msgs.values.radar import RangeAzimuthGrid

#: A network of the family that takes a second to write.
SMALL = SwinUNetConfig(
    range_bins=320, columns=256, crop_columns=0, patch=(4, 8), embed=12, depths=(1, 1, 1, 1), heads=(1, 2, 3, 6),
    head_hidden=16, output_bias=True,
)  # fmt: skip
#: Fresh weights answer 0.1 everywhere, a little more where there is an echo.
THRESHOLD = 0.1


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shipped weights, and fresh ones of the specification's networks by their names."""
    folder = tmp_path_factory.mktemp("weights")
    for path in WEIGHTS.iterdir():
        if path.name.partition(".")[0] not in ("swin_unet", "residual_reflect_net"):
            (folder / path.name).symlink_to(path)
    torch.manual_seed(0)
    encoding = Encoding(range_bins=SMALL.range_bins, columns=SMALL.columns, channels=COMPLEX)
    network, path = choice_of("swin_unet", SMALL).build().eval(), folder / "swin_unet.compact.onnx"
    card = ModelCard(
        name="swin_unet.compact", sha256=export_onnx(Exported(network), path), network="swin_unet", parameters=934372,
        encoding=encoding, grid=RangeAzimuthGrid(), input_shape=(1, *encoding.shape),
        output_shape=(1, *SMALL.output_shape), threshold=THRESHOLD,
    )  # fmt: skip
    write_card(card, path)
    residual, path = ResidualReflectNet().eval(), folder / "residual_reflect_net.onnx"
    of_residual = ResidualCard(
        name="residual_reflect_net", sha256=export_residual_onnx(residual, path), parameters=120706, frame="wall",
        neighbours=16, source="peaks", geometry="published", seed=0, command="", data={}, metrics={}, training={},
    )  # fmt: skip
    write_card(of_residual, path)
    return folder


def write_yaml(path: Path, content: object) -> Path:
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture
def weights(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(cards, "WEIGHTS", folder)
    monkeypatch.setattr(table, "WEIGHTS", folder)
    return folder


def test_it_runs_section_3_from_raw_beams(weights: Path) -> None:
    """Step by step to the view's points: two channels by their rms, local maxima, lines, Eqs. (18) to (21)."""
    perception = Perception(profile="specification")
    (view,) = (view for beam in LabelledPlace(5, 1, "basic").beams() for view in perception.add(beam))
    assert view.ra_map is not None
    predictor = DensePredictor(weights / "swin_unet.compact.onnx")
    encoded = encode_map(predictor.card.encoding, view.ra_map)
    seen = view.ra_map.values[: SMALL.range_bins]
    np.testing.assert_allclose(encoded[0] + 1j * encoded[1], seen / np.sqrt(np.mean(np.abs(seen) ** 2)), atol=1e-5)
    assert not encoded[2].any()
    peaks = find_peaks(predictor.predict(view.ra_map), view.ra_map, PeakParams(threshold=THRESHOLD))
    np.testing.assert_array_equal(view.peaks.range_m, peaks.range_m)
    recovered = fold_scan(
        peaks, GeometryParams(back_end="specification"), LearnedResidual(weights / "residual_reflect_net.onnx")
    ).recovered
    assert len(recovered) > 0
    np.testing.assert_array_equal([(one.x_m, one.y_m) for one in view.frame.points], recovered.points_m)


def test_a_profile_by_file_runs_in_every_verb(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_yaml(tmp_path / "mine.yaml", read_profile("specification"))
    assert read_profile(str(file)) == read_profile("specification")
    assert profile_setting(str(file)).params == profile_setting("specification").params
    assert str(file) in [row.name for row in read_settings(profile_files=[str(file)])]
    words = ["eval", "--objects", "--profile", str(file), "--count", "1", "--effects", "basic", "--json"]
    assert main(words) == 0
    assert str(file) in json.loads(capsys.readouterr().out)["mean_loss"]


@pytest.mark.parametrize(
    ("profile", "fault"),
    [
        ({"geometry": {"back_end": "published"}}, "geometry.back_end: Invalid enum value 'published'; known are ours"),
        (
            {"geometry": {"back_end": "specification", "object_network": "evidence_unet.int8"}},
            "object_network must be none",
        ),
        (
            {"geometry": {"residual": "residual_reflect_net"}},
            "card.geometry must be 'ours' for back_end ours, got 'pub",
        ),
        ({"geometry": {"residual": "swin_unet.compact"}}, "swin_unet.compact.json: lacks frame, neighbours"),
        ({"dense_predictor": {"model": "residual_reflect_net"}}, "residual_reflect_net.json: lacks encoding, grid"),
        ({"dense_predictor": {"model": "swin_unet.huge"}}, "swin_unet.huge.onnx: No such file"),
        ({"geometry": 3}, "geometry: expected a mapping of parameters, got a number"),
        ({"geometri": {}}, "unknown node 'geometri'"),
    ],
)
def test_what_does_not_belong_together_is_one_line(
    profile: dict[str, object], fault: str, weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_yaml(tmp_path / "bad.yaml", profile)
    with pytest.raises(ValueError, match=r"\A[^\n]*\Z") as caught:
        Perception(profile=str(file))
    assert fault in str(caught.value)


def test_missing_weights_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cards, "WEIGHTS", tmp_path)
    with pytest.raises(ValueError, match=r"\A[^\n]*swin_unet.compact.onnx: No such file[^\n]*\Z"):
        Perception(profile="specification")
    assert "specification" in profile_names()
    assert (PROFILES / "specification.yaml").is_file()


def test_the_table_goes_on_and_keeps_the_reason_of_what_cannot_run(
    weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["eval", "--table", "5", "--seed", "5", "--effects", "basic", "--json", "--count", "1"]
    out = tmp_path / "out"
    assert main([*words, "--out", str(out)]) == 0
    report = json.loads(capsys.readouterr().out)
    rows = {row["name"]: row for row in report["rows"]}
    swin = rows["Swin-UNet with residual, 0.934 M fp32"]
    assert swin["published"]["recovered_1m_f1"] == 0.45
    assert (
        swin["measures"]["dense_macro_f1"]
        == rows["Swin-UNet without residual, 0.934 M fp32"]["measures"]["dense_macro_f1"]
    )
    assert "0.934 of 41.39 M parameters" in swin["why"]
    assert rows["default"]["measures"]["dense_macro_f1"]["value"] > 0.5
    assert rows["CFAR-NLOS (given the truth)"]["measures"]["dense_macro_f1"]["value"] > 0.3
    for row in rows.values():
        assert bool(row["failed"]) != bool(row["measures"])
    plan = table.TablePlan(seed=5, places=1, rows=table.table_rows(), effects="basic")
    monkeypatch.setattr(table, "measure_place", None)
    assert [result.frame for result in table.run_table(plan, out)] == [0]
    assert (out / "scenes-1.png").read_bytes().startswith(b"\x89PNG")
    assert "(0.45)" in (out / "table.md").read_text()
