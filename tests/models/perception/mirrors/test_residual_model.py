"""The learned residual on the vehicle: wall coordinates, bounds, and what it refuses."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from lab.networks.residual_reflect_net import ResidualReflectNet
from lab.training.export.onnx import write_card
from lab.training.export.residual import PARITY_M, export_residual_onnx
from models.perception.find.onnx_model import card_path
from models.perception.mirrors import residual_model
from models.perception.mirrors.recovery import ReflectionState
from models.perception.mirrors.residual_model import (
    LearnedResidual,
    ResidualCard,
    bounded,
    in_frames,
    wall_frames,
)

#: A facade 12 m ahead that the radar looks at along its normal.
STATE = ReflectionState(
    images_m=np.array([[20.0, 3.0], [16.0, -4.0]]),
    patch_m=np.tile(np.linspace([12.0, -5.0], [12.0, 5.0], 16), (2, 1, 1)),
    state=np.array([[20.0, 3.0, -1.0, 0.0, 12.0, 0.0], [16.0, -4.0, -1.0, 0.0, 12.0, 1.0]]),
)


def turned(reflection: ReflectionState, angle_rad: float, mirrored: bool = False) -> ReflectionState:
    """The same scene turned about the radar, left and right exchanged first where `mirrored`."""
    turn = np.array([[math.cos(angle_rad), -math.sin(angle_rad)], [math.sin(angle_rad), math.cos(angle_rad)]])
    turn = turn @ np.diag([1.0, -1.0 if mirrored else 1.0])
    state = reflection.state.copy()
    state[:, :2], state[:, 2:4] = state[:, :2] @ turn.T, state[:, 2:4] @ turn.T
    return ReflectionState(reflection.images_m @ turn.T, reflection.patch_m @ turn.T, state)


@pytest.fixture(scope="module")
def network() -> ResidualReflectNet:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return ResidualReflectNet().eval()


def written(network: ResidualReflectNet, path: Path) -> Path:
    card = ResidualCard(
        name="residual", sha256=export_residual_onnx(network, path), parameters=1, frame="wall", neighbours=16,
        source="peaks", geometry="ours", seed=0, command="", data={}, metrics={}, training={},
    )  # fmt: skip
    write_card(card, path)
    return path


@pytest.fixture
def model(network: ResidualReflectNet, tmp_path: Path) -> Path:
    return written(network, tmp_path / "residual.onnx")


def test_wall_coordinates_of_a_facade() -> None:
    """Foot of the radar at (12, 0), normal back to it: along is |y|, across 12 - x."""
    frames = wall_frames(STATE)
    seen = in_frames(STATE, frames)
    np.testing.assert_allclose(seen.images_m, [[3.0, -8.0], [4.0, -4.0]], atol=1e-12)
    np.testing.assert_allclose(seen.state[:, 2:], [[0.0, 1.0, 12.0, 0.0], [0.0, 1.0, 12.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(seen.patch_m[:, :, 1], 0.0, atol=1e-12)
    # the radar stands where the state's offset says
    np.testing.assert_allclose(frames.points(np.zeros((2, 2))), [[0.0, 12.0], [0.0, 12.0]], atol=1e-12)


@pytest.mark.parametrize("mirrored", [False, True])
def test_wall_coordinates_know_no_turn_and_no_side(mirrored: bool) -> None:
    other = turned(STATE, 0.7, mirrored)
    one, two = (in_frames(scene, wall_frames(scene)) for scene in (STATE, other))
    np.testing.assert_allclose(two.images_m, one.images_m, atol=1e-12)
    np.testing.assert_allclose(two.patch_m, one.patch_m, atol=1e-12)
    np.testing.assert_allclose(two.state, one.state, atol=1e-12)


def test_offsets_go_there_and_back() -> None:
    frames = wall_frames(STATE)
    offsets_m = np.array([[1.0, 2.0], [-0.5, 0.25]])
    np.testing.assert_allclose(frames.to_radar(frames.from_radar(offsets_m)), offsets_m, atol=1e-12)
    # the difference of two points turns as an offset does
    moved = frames.points(STATE.images_m + offsets_m) - frames.points(STATE.images_m)
    np.testing.assert_allclose(frames.from_radar(offsets_m), moved, atol=1e-12)


def test_long_corrections_are_scaled_down_and_short_ones_stay() -> None:
    offsets_m = np.array([[30.0, 40.0], [0.3, -0.4], [0.0, 0.0]])
    np.testing.assert_allclose(bounded(offsets_m), [[3.0, 4.0], [0.3, -0.4], [0.0, 0.0]])


@pytest.mark.parametrize("count", [0, 1, 2])
def test_answers_what_torch_answers(
    model: Path, network: ResidualReflectNet, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(residual_model, "MAX_SHIFT_M", 1e3)
    part = ReflectionState(STATE.images_m[:count], STATE.patch_m[:count], STATE.state[:count])
    offsets_m = LearnedResidual(model)(part)
    frames = wall_frames(part)
    seen = in_frames(part, frames)
    with torch.no_grad():
        arrays = (torch.from_numpy(a.astype(np.float32)) for a in (seen.images_m, seen.patch_m, seen.state))
        wanted_m = frames.to_radar(network(*arrays).numpy())
    assert offsets_m.shape == (count, 2)
    np.testing.assert_allclose(offsets_m, wanted_m, atol=PARITY_M)


def test_the_correction_turns_with_the_scene(model: Path) -> None:
    """float32 inside: equal to 1e-4 m."""
    turn = np.array([[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]])
    learned = LearnedResidual(model)
    np.testing.assert_allclose(learned(turned(STATE, 0.7)), learned(STATE) @ turn.T, atol=1e-4)


def test_a_network_that_throws_is_held(network: ResidualReflectNet, tmp_path: Path) -> None:
    thrower = ResidualReflectNet()
    thrower.load_state_dict(network.state_dict())
    torch.nn.init.zeros_(thrower.decoder[-1].weight)
    with torch.no_grad():
        thrower.decoder[-1].bias.copy_(torch.tensor([300.0, -400.0]))
    learned = LearnedResidual(written(thrower, tmp_path / "thrower.onnx"))
    np.testing.assert_allclose(learned(STATE), wall_frames(STATE).to_radar(np.array([[3.0, -4.0]] * 2)), atol=1e-6)


def test_input_that_is_not_finite_is_refused_with_its_image(model: Path) -> None:
    patch_m = STATE.patch_m.copy()
    patch_m[1, 3, 0] = np.nan
    with pytest.raises(ValueError, match=r"reflection\.patch must be finite, image 1 is not"):
        LearnedResidual(model)(ReflectionState(STATE.images_m, patch_m, STATE.state))


def test_input_of_another_shape_is_refused(model: Path) -> None:
    with pytest.raises(ValueError, match=r"reflection\.patch must have shape \(2, 16, 2\), got \(2, 8, 2\)"):
        LearnedResidual(model)(ReflectionState(STATE.images_m, STATE.patch_m[:, :8], STATE.state))


def change_card(model: Path, **changes: object) -> None:
    card = msgspec.json.decode(card_path(model).read_bytes())
    card_path(model).write_bytes(msgspec.json.encode(card | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sha256": "0" * 64}, r"residual\.onnx: sha256 must be 0{64} as its card says, got"),
        ({"neighbours": 8}, r"residual\.onnx: inputs and output of the network must be .*\(8, 2\).*got .*\(16, 2\)"),
        ({"neighbours": 0}, r"residual\.json: card\.neighbours must be at least 1, got 0"),
        ({"frame": "moon"}, r"residual\.json: frame: .*'moon'; known are wall"),
    ],
)
def test_a_card_that_does_not_belong_is_refused(model: Path, changes: dict[str, object], message: str) -> None:
    change_card(model, **changes)
    with pytest.raises(ValueError, match=message):
        LearnedResidual(model)


def test_a_missing_card_is_named(model: Path) -> None:
    card_path(model).unlink()
    with pytest.raises(ValueError, match=r"residual\.json"):
        LearnedResidual(model)


def test_threads_must_be_positive(model: Path) -> None:
    with pytest.raises(ValueError, match=r"threads must be at least 1, got 0"):
        LearnedResidual(model, threads=0)
