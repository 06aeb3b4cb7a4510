from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from lab.networks.compact_unet import CompactUNet, CompactUNetConfig
from lab.networks.radar_tensor_network import RadarTensorNetwork, RadarTensorNetworkConfig
from lab.training.export.onnx import PARITY, Exported, export_onnx, write_card
from models.perception.find.anchors import anchor_points
from models.perception.find.detectors import NetworkDetector
from models.perception.find.encoding import Encoding, encode_map
from models.perception.find.onnx_model import ClassScores, DensePredictor, ModelCard, ScoresAt, card_path
from models.perception.find.peaks import local_maxima
from models.perception.mirrors.peaks_to_view import GeometryParams, recover_bev
from msgs.values.radar import RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from tests.builders import example_map

GRID = RangeAzimuthGrid(range_bins=48, azimuth_bins=64)
ENCODING = Encoding(range_bins=32, columns=8)
CONFIG = CompactUNetConfig(range_bins=32, columns=8, widths=(8, 16), attention_heads=2, attention_blocks=1)


def ra_map(grid: RangeAzimuthGrid = GRID) -> RangeAzimuthMap:
    rng = np.random.default_rng(0)
    values = rng.standard_normal(grid.shape) + 1j * rng.standard_normal(grid.shape)
    return example_map(values, grid=grid)


@pytest.fixture(scope="module")
def network() -> CompactUNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return CompactUNet(CONFIG).eval()


@pytest.fixture
def model(network: CompactUNet, tmp_path: Path) -> Path:
    path = tmp_path / "net.onnx"
    sha256 = export_onnx(Exported(network), path)
    best = ClassScores(precision=1.0, recall=1.0, f1=1.0)
    card = ModelCard(
        name="net",
        sha256=sha256,
        parameters=1,
        encoding=ENCODING,
        grid=GRID,
        input_shape=(1, 5, 32, 8),
        output_shape=(1, 2, 32, 64),
        threshold=0.3,
        scores=(ScoresAt(threshold=0.3, macro_f1=1.0, los=best, mirrored=best),),
        data={},
        training={},
    )
    write_card(card, path)
    return path


def change_card(model: Path, **changes: object) -> None:
    card = msgspec.json.decode(card_path(model).read_bytes())
    card_path(model).write_bytes(msgspec.json.encode(card | changes))


def test_predicts_what_torch_predicts_and_nothing_beyond_its_range(model: Path, network: CompactUNet) -> None:
    """Probabilities within the export's own tolerance; the 16 bins beyond the crop are zero."""
    # louder at its lower azimuths: the network looks at it as it is
    seen = msgspec.structs.replace(ra_map(), values=ra_map().values[:, ::-1])
    encoded = encode_map(ENCODING, seen)
    assert not ENCODING.is_turned(encoded)
    confidence = DensePredictor(model).predict(seen)
    with torch.no_grad():
        wanted = torch.sigmoid(network(torch.from_numpy(encoded[None])))[0].numpy()
    assert confidence.dtype == np.float32
    assert confidence.shape == (2, *GRID.shape)
    np.testing.assert_allclose(confidence[:, :32], wanted, atol=PARITY)
    assert (confidence[:, 32:] == 0.0).all()


def test_threads_change_nothing(model: Path) -> None:
    """Convolutions may add in another order: float32 rounding of probabilities below 1."""
    one, two = (DensePredictor(model, threads=n).predict(ra_map()) for n in (1, 2))
    np.testing.assert_allclose(one, two, atol=1e-6)


def test_other_grid_is_refused(model: Path) -> None:
    other = RangeAzimuthGrid(range_bins=48, azimuth_bins=128)
    with pytest.raises(ValueError, match=r"map\.grid\.azimuth_bins must be 64, as net was trained, got 128"):
        DensePredictor(model).predict(ra_map(other))


def test_file_that_is_not_the_cards_is_refused(model: Path) -> None:
    model.write_bytes(model.read_bytes() + b"\0")
    with pytest.raises(ValueError, match=r"net\.onnx: sha256 must be [0-9a-f]{64} as its card says, got [0-9a-f]{64}"):
        DensePredictor(model)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"input_shape": [1, 5, 32, 16]},
            r"net\.onnx: input must be \(1, 5, 32, 16\) as its card says, got \(1, 5, 32, 8",
        ),
        (
            {"output_shape": [1, 3, 32, 64]},
            r"net\.onnx: output must be \(1, 3, 32, 64\) as its card says, got \(1, 2, 32",
        ),
        ({"encoding": {"range_bins": 16, "columns": 8}}, r"net\.json: card\.input_shape must be \(1, 5, 16, 8\)"),
        ({"grid": {"range_bins": 48, "azimuth_bins": 128}}, r"net\.json: card\.output_shape must be \(1, 2, 32, 128\)"),
        ({"head": "anchors"}, r"net\.json: card\.output_shape must be \(1, 5, 32, 64\), got \(1, 2, 32, 64\)"),
        ({"anchor_stride": 0}, r"net\.json: card\.anchor_stride must be at least 1, got 0"),
        ({"precision": "fp8"}, r"net\.json: precision: Invalid enum value 'fp8'; known are fp16, fp32, int8"),
        ({"sha256": 3}, r"net\.json: sha256: Expected `str`, got `int`"),
    ],
)
def test_card_that_does_not_fit_is_refused(model: Path, changes: dict[str, object], message: str) -> None:
    change_card(model, **changes)
    with pytest.raises(ValueError, match=message):
        DensePredictor(model)


def test_all_that_is_wrong_is_said_at_once(model: Path) -> None:
    """Checksum, shapes and card in one message, each once, and where it says how to make them."""
    model.write_bytes(model.read_bytes() + b"\0\0")
    change_card(model, input_shape=[1, 5, 32, 16], output_shape=[1, 3, 32, 64])
    with pytest.raises(ValueError) as caught:
        DensePredictor(model)
    said = str(caught.value)
    for part in (
        "net.onnx: sha256 must be ",
        "net.json: card.input_shape must be (1, 5, 32, 8), got (1, 5, 32, 16)",
        "net.json: card.output_shape must be (1, 2, 32, 64), got (1, 3, 32, 64)",
        "docs/guides/train-on-my-captures.md",
    ):
        assert said.count(part) == 1
    assert "\n" not in said


def test_a_network_without_a_card_is_told_what_one_holds(model: Path) -> None:
    """Of a network from elsewhere its shapes are said: they are what the card must name."""
    card_path(model).unlink()
    with pytest.raises(ValueError) as caught:
        DensePredictor(model)
    for part in ("net.json: No such file", "input is (1, 5, 32, 8)", "output is (1, 2, 32, 64)", "guides/train-on"):
        assert part in str(caught.value)
    card_path(model).write_text('{"name": "mine", "threshold": "high", "precision": "fp8"}')
    with pytest.raises(ValueError) as caught:
        DensePredictor(model)
    lacks = "lacks sha256, encoding, grid, input_shape, output_shape"
    for part in (lacks, "threshold: Expected `float`, got `str`", "precision: Invalid enum value 'fp8'"):
        assert part in str(caught.value)


def test_older_card_with_fields_of_its_own_loads(model: Path) -> None:
    """Cards once named their channels beside the encoding, and knew neither head nor precision."""
    card = msgspec.json.decode(card_path(model).read_bytes())
    for name in ("network", "precision", "head", "anchor_stride", "fidelity"):
        del card[name]
    card_path(model).write_bytes(msgspec.json.encode(card | {"channels": ["level"]}))
    loaded = DensePredictor(model).card
    assert (loaded.network, loaded.precision, loaded.head) == ("compact_unet", "fp32", "heatmap")


def test_points_of_a_heatmap_are_its_maxima(model: Path) -> None:
    predictor = DensePredictor(model)
    answer, points = predictor.answer(ra_map()), predictor.points(ra_map(), threshold=0.1, min_distance=3)
    cells = [local_maxima(channel, 0.1, 3) for channel in answer]
    np.testing.assert_array_equal(points.cells, np.concatenate(cells))
    assert points.path_class.tolist() == [0] * len(cells[0]) + [1] * len(cells[1])
    assert len(points.score) > 0
    np.testing.assert_array_equal(points.score[: len(cells[0])], answer[0][tuple(cells[0].T)])


def test_network_with_anchors_answers_points_and_no_heatmap(model: Path, tmp_path: Path) -> None:
    torch.manual_seed(0)
    config = RadarTensorNetworkConfig(
        in_channels=5, range_bins=32, columns=64, anchor_stride=2, widths=(4, 8), blocks=(1, 1), neck_width=4
    )
    path = tmp_path / "rtn.onnx"
    card = msgspec.structs.replace(
        DensePredictor(model).card,
        name="rtn",
        sha256=export_onnx(Exported(RadarTensorNetwork(config)), path),
        head="anchors",
        anchor_stride=2,
        encoding=Encoding(range_bins=32, columns=64),
        input_shape=(1, 5, 32, 64),
        output_shape=(1, 5, 16, 32),
    )
    write_card(card, path)
    predictor = DensePredictor(path)
    points = predictor.points(ra_map(), threshold=0.1, min_distance=3)
    found = anchor_points(predictor.answer(ra_map()), 2, 0.1, 3)
    cells, score, path_class = found.cells, found.score, found.path_class
    assert len(cells) > 0
    np.testing.assert_array_equal(points.cells, cells)
    np.testing.assert_array_equal(points.score, score)
    np.testing.assert_array_equal(points.path_class, path_class)
    with pytest.raises(ValueError, match=r"rtn: card\.head must be heatmap for a heatmap, got anchors"):
        predictor.predict(ra_map())
    with pytest.raises(ValueError, match=r"rtn\.onnx: flip_test must go with a heatmap"):
        DensePredictor(path, flip_test=True)


@pytest.mark.parametrize("flip_test", [False, True])
def test_left_and_right_are_alike(model: Path, flip_test: bool) -> None:
    """Exchanging left and right of the map exchanges them in the answer, bit for bit, but not in one look."""
    seen, flipped = ra_map(), msgspec.structs.replace(ra_map(), values=ra_map().values[:, ::-1])
    predictor = DensePredictor(model, flip_test=flip_test)
    np.testing.assert_array_equal(predictor.predict(flipped)[..., ::-1], predictor.predict(seen))
    here, there = (predictor.infer(encode_map(predictor.card.encoding, one)) for one in (seen, flipped))
    assert np.abs(there[..., ::-1] - here).max() > 1e-3


def test_missing_files_are_named(model: Path) -> None:
    model.unlink()
    with pytest.raises(ValueError, match=r"net\.onnx: .*No such file"):
        DensePredictor(model)
    card_path(model).unlink()
    with pytest.raises(ValueError, match=r"net\.json: .*No such file"):
        DensePredictor(model)


def test_no_threads_are_refused(model: Path) -> None:
    with pytest.raises(ValueError, match="threads must be at least 1, got 0"):
        DensePredictor(model, threads=0)


@pytest.fixture(scope="module")
def shipped() -> DensePredictor:
    return DensePredictor()


def shipped_map(values: np.ndarray, noise_power_mw: float) -> RangeAzimuthMap:
    blank = ra_map(RangeAzimuthGrid())
    return msgspec.structs.replace(blank, values=values.astype(np.complex64), noise_power_mw=noise_power_mw)


def test_shipped_network_is_as_good_as_its_card_must_say(shipped: DensePredictor) -> None:
    """On the test scenes of random places with all effects, by the published maxima; the first series of plain streets,
    on which its forerunner had 0.88, is another and easier question."""
    line = next(line for line in shipped.card.scores if line.threshold == shipped.card.threshold)
    assert line.macro_f1 >= 0.80
    assert line.los.f1 >= 0.85
    # a false image where nothing is hidden is the costliest error
    assert line.mirrored.precision >= 0.75


@pytest.mark.slow
def test_shipped_network_sees_nothing_in_noise() -> None:
    """Layout: receiver noise alone, as 15 co-array coefficients a row make it: 512 x 15 independent values a map. One
    in 100,000 may be called a return, 2.3 in 30 maps; none may become an object.
    """
    detector, steering = NetworkDetector(RadarSetup()), np.sin(RangeAzimuthGrid().azimuth_rad)
    steering = np.exp(1j * np.pi * np.multiply.outer(np.arange(-7, 8), steering))
    called = 0
    for seed in range(30):
        draws = np.random.default_rng(seed).standard_normal((512, 15, 2))
        coefficients = draws @ np.array([1.0, 1.0j]) / np.sqrt(30.0)
        peaks = detector.detect(shipped_map(1e-6 * coefficients @ steering, noise_power_mw=1e-12))
        called += len(peaks)
        assert not recover_bev(peaks, GeometryParams()).objects
    assert called <= 2


def test_a_detector_looks_twice_where_it_is_asked_to() -> None:
    """Three points of 40 dB over noise: other scores than of one look, and a name that says so."""
    draws = np.random.default_rng(3).standard_normal((512, 15, 2))
    coefficients = 1e-6 * draws @ np.array([1.0, 1.0j]) / np.sqrt(30.0)
    places, sine = np.arange(-7, 8), np.sin(RangeAzimuthGrid().azimuth_rad)
    for row, azimuth_rad in ((60, 0.2), (90, -0.5), (140, 0.4)):
        coefficients[row] += 1e-4 * (8.0 - np.abs(places)) / 64.0 * np.exp(-1j * np.pi * places * np.sin(azimuth_rad))
    seen = shipped_map(coefficients @ np.exp(1j * np.pi * np.multiply.outer(places, sine)), noise_power_mw=1e-12)
    once, twice = (NetworkDetector(RadarSetup(), flip_test=flip_test).detect(seen) for flip_test in (False, True))
    assert len(once)
    assert twice.detector == f"{once.detector}/flip_test"
    assert not np.array_equal(once.score, twice.score)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e30])
def test_shipped_network_answers_probabilities_for_any_map(shipped: DensePredictor, scale: float) -> None:
    values = scale * np.random.default_rng(0).standard_normal(RangeAzimuthGrid().shape)
    for noise_power_mw in (0.0, 1e-13):
        confidence = shipped.predict(shipped_map(values, noise_power_mw))
        assert np.isfinite(confidence).all()
        assert 0.0 <= confidence.min() <= confidence.max() <= 1.0
