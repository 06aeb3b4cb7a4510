"""Hard cases of the learned residual: empty scans, points on top of each other, far away or on the wall's foot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from lab.networks.residual_reflect_net import ResidualReflectNet
from lab.training.export.onnx import write_card
from lab.training.export.residual import export_residual_onnx
from models.perception.mirrors.peaks_to_view import GeometryParams, fold_scan, recover_bev
from models.perception.mirrors.recovery import ReflectionState
from models.perception.mirrors.residual_model import MAX_SHIFT_M, LearnedResidual, ResidualCard, in_frames, wall_frames
from msgs.bus.interface import Envelope, Received
from nodes import geometry
from tests.builders import peaks_at


def write_network(network: ResidualReflectNet, path: Path) -> Path:
    card = ResidualCard(
        name=path.stem, sha256=export_residual_onnx(network, path), parameters=1, frame="wall", neighbours=16,
        source="peaks", geometry="ours", seed=0, command="", data={}, metrics={}, training={},
    )  # fmt: skip
    write_card(card, path)
    return path


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return write_network(ResidualReflectNet(), tmp_path_factory.mktemp("residual") / "net.onnx")


@pytest.fixture(scope="module")
def residual(model: Path) -> LearnedResidual:
    return LearnedResidual(model)


FACADE = [[12.0, y] for y in np.linspace(-6.0, 6.0, 13)]


def state_of(image_m: list[float], patch_m: np.ndarray, offset_m: float = 12.0) -> ReflectionState:
    state = np.array([[*image_m, -1.0, 0.0, offset_m, 0.0]])
    return ReflectionState(np.array([image_m]), np.broadcast_to(patch_m, (1, 16, 2)).copy(), state)


@pytest.mark.parametrize(
    ("returns", "images"),
    [([], []), (FACADE, []), ([], [[20.0, 3.0]]), ([[12.0, 0.0]], [[20.0, 3.0]]), ([[0.0, 0.0]], [[20.0, 3.0]])],
    ids=["nothing", "no images", "no returns", "one return", "a return at the radar"],
)
def test_scans_without_much_in_them_pass(
    residual: LearnedResidual, returns: list[list[float]], images: list[list[float]]
) -> None:
    """Both back ends answer, and every place they give is finite."""
    peaks = peaks_at(returns, images)
    view = recover_bev(peaks, GeometryParams(), residual)
    assert np.isfinite([[point.x_m, point.y_m] for point in view.points]).all()
    assert np.isfinite(fold_scan(peaks, GeometryParams(back_end="specification"), residual).recovered.points_m).all()


@pytest.mark.parametrize(
    "reflection",
    [
        state_of([20.0, 0.0], np.array([12.0, 0.0])),
        state_of([12.0, 0.0], np.array([12.0, 0.0])),
        state_of([20.0, 3.0], np.array([20.0, 3.0])),
        state_of([0.0, 0.0], np.zeros(2), 0.0),
        state_of([1e6, 1e6], np.array([-1e6, 1e6]), 1e6),
        state_of([20.0, 3.0], np.array([1e-30, -1e-30]), 1e-30),
    ],
    ids=["behind the foot", "on the foot", "patch on the image", "all at the radar", "a thousand km", "denormal"],
)
def test_corrections_stay_finite_and_bounded(residual: LearnedResidual, reflection: ReflectionState) -> None:
    offsets_m = residual(reflection)
    assert np.isfinite(offsets_m).all()
    assert np.linalg.norm(offsets_m, axis=1).max() <= MAX_SHIFT_M * (1.0 + 1e-12)


def test_numbers_beyond_float32_are_refused_not_answered(residual: LearnedResidual) -> None:
    """1e300 m is finite in float64 and not in the network's float32."""
    with np.errstate(over="ignore"), pytest.raises(ValueError, match="residuals must be finite"):
        residual(state_of([1e300, 0.0], np.array([12.0, 0.0])))


def test_an_image_is_corrected_alike_whatever_stands_beside_it(residual: LearnedResidual) -> None:
    """float32 products may add in another order: 1e-5 m."""
    rng = np.random.default_rng(0)
    images_m, patch_m = rng.uniform(10.0, 30.0, (200, 2)), rng.uniform(0.0, 20.0, (200, 16, 2))
    normal = rng.standard_normal((200, 2))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    many = ReflectionState(images_m, patch_m, np.column_stack([images_m, normal, np.full(200, 9.0), np.zeros(200)]))
    together = residual(many)
    for i in (0, 57, 199):
        alone = residual(ReflectionState(images_m[[i]], patch_m[[i]], many.state[[i]]))
        np.testing.assert_allclose(alone[0], together[i], atol=1e-5)


def test_a_hairs_breadth_to_either_side_of_the_foot_changes_little(residual: LearnedResidual) -> None:
    """The tangent turns over at the foot: what lies there is mirrored, and so is its correction; 1e-3 m."""
    patch_m = np.stack([np.full(16, 12.0), np.linspace(-5.0, 5.0, 16)], axis=1)
    left, right = (residual(state_of([20.0, side * 1e-6], side * patch_m * [side, 1.0]))[0] for side in (1.0, -1.0))
    np.testing.assert_allclose(left, right * [1.0, -1.0], atol=1e-3)


def test_wall_frames_do_not_write_into_their_input() -> None:
    reflection = state_of([20.0, -3.0], np.array([12.0, 0.0]))
    before = reflection.state.copy()
    in_frames(reflection, wall_frames(reflection)).state[:] = 0.0
    np.testing.assert_array_equal(reflection.state, before)


def test_a_network_of_nans_is_refused_at_start(tmp_path: Path) -> None:
    network = ResidualReflectNet()
    torch.nn.init.constant_(network.decoder[-1].bias, float("nan"))
    with pytest.raises(ValueError, match=r"nan\.onnx: residuals must be finite, got nan"):
        LearnedResidual(write_network(network, tmp_path / "nan.onnx"))


def test_the_geometry_node_moves_places_only_with_a_residual(model: Path) -> None:
    """One image behind a facade: the node's place with `residual` is that without plus the network's correction."""
    envelope = Envelope(publisher="test", topic="perception/peaks", sequence=0, sent_ns=0)
    scan = [Received("perception/peaks", peaks_at(FACADE, [[18.0, 4.0]]), envelope)]
    views = [geometry.create(geometry.Params(residual=name)).step(scan, 0)[0].message for name in ("none", str(model))]
    (without,), (with_residual,) = (view.points for view in views)
    assert (without.x_m, without.y_m) == pytest.approx((6.0, 4.0), abs=1e-6)
    moved_m = np.hypot(with_residual.x_m - without.x_m, with_residual.y_m - without.y_m)
    assert 1e-3 < moved_m <= MAX_SHIFT_M
