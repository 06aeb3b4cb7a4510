"""Losses of the field and evidence networks: least at the truth, silent where nothing is asked."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from lab.training.objectives.evidence import EvidenceTargets, evidence_loss, heat_loss, wall_loss
from models.perception.see.detections import ANSWERS, OBJECT, PLACE
from models.perception.see.gathering import BirdsEyeGrid
from models.perception.see.wall_elements import BEYOND_M

PLANE = BirdsEyeGrid()
X_M, Y_M = torch.from_numpy(PLANE.x_m).float(), torch.from_numpy(PLANE.y_m).float()
TOWARD = torch.tensor([1.0, 0.0])[None, :, None, None].expand(1, 2, *PLANE.shape)


def targets(asked: bool) -> EvidenceTargets:
    place = torch.tensor([[14.0, -3.0]])
    zero = torch.zeros(1, 2)
    return EvidenceTargets(
        torch.zeros(1, dtype=torch.int64),
        place,
        place,
        zero,
        zero,
        torch.zeros(1, dtype=torch.int64),
        torch.tensor([asked]),
    )


def loss_of(answer: torch.Tensor, asked: bool) -> torch.Tensor:
    return evidence_loss(answer, targets(asked), TOWARD, X_M, Y_M)


def test_an_object_is_asked_for_and_its_place() -> None:
    answer = torch.full((1, ANSWERS, *PLANE.shape), 0.0)
    answer[:, OBJECT] = -6.0
    row, column = int((X_M - 14.0).abs().argmin()), int((Y_M + 3.0).abs().argmin())
    answer[0, OBJECT, row, column] = 4.0
    answer[0, PLACE, row, column] = torch.tensor([14.0, -3.0]) - torch.stack([X_M[row], Y_M[column]])
    right = loss_of(answer, True)
    answer[0, OBJECT, row, column] = -4.0
    assert right < loss_of(answer, True) - 0.5
    answer[0, OBJECT, row, column], answer[0, PLACE, row, column] = 4.0, 2.0
    assert right < loss_of(answer, True)


def test_an_object_that_nothing_leads_to_is_neither_asked_for_nor_denied() -> None:
    """No gradient within 2 m of it; beyond that a report is denied."""
    answer = torch.zeros((1, ANSWERS, *PLANE.shape), requires_grad=True)
    loss_of(answer, False).backward()
    assert answer.grad is not None
    row, column = int((X_M - 14.0).abs().argmin()), int((Y_M + 3.0).abs().argmin())
    assert not answer.grad[0, OBJECT, row, column].any()
    assert answer.grad[0, OBJECT, row + 6, column].abs().max() > 0.0


def test_a_scan_without_objects_has_a_finite_loss() -> None:
    nothing = EvidenceTargets(
        *(torch.zeros(0, dtype=torch.int64), *(torch.zeros(0, 2) for _ in range(4))),
        torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.bool),
    )  # fmt: skip
    answer = torch.zeros((1, ANSWERS, *PLANE.shape))
    assert torch.isfinite(evidence_loss(answer, nothing, TOWARD, X_M, Y_M))


@pytest.mark.parametrize("angle_rad", [0.0, 0.9, -0.9])
def test_the_wall_loss_is_least_at_the_wall(angle_rad: float) -> None:
    cells_m = 0.2 * torch.arange(64).float()
    range_m, angle = torch.full((1, 8), 6.0), torch.full((1, 8), angle_rad)
    range_m[0, 5] = np.inf
    beyond_m = (cells_m[None, :, None] - torch.where(torch.isfinite(range_m), range_m, 1e4)[:, None]) * math.cos(
        angle_rad
    )
    answer = torch.zeros(1, 4, 64, 8)
    answer[:, 0] = torch.where(beyond_m.abs() <= 0.3, 6.0, -6.0)
    answer[:, 1] = beyond_m / BEYOND_M
    answer[:, 2], answer[:, 3] = math.cos(angle_rad), math.sin(angle_rad)
    least = wall_loss(answer, range_m, angle, cells_m)
    assert least < 0.1
    turned, late = answer.clone(), answer.clone()
    turned[:, 3] += 0.3
    late[:, 0] = answer[:, 0].roll(5, dims=1)
    assert wall_loss(turned, range_m, angle, cells_m) > least + 0.1
    assert wall_loss(late, range_m, angle, cells_m) > least + 1.0


def test_the_heat_loss_knows_class_and_cell() -> None:
    scan, row, column = torch.tensor([0]), torch.tensor([7]), torch.tensor([1])
    right = torch.full((1, 2, 16, 8), -5.0)
    right[0, 1, 7, 1] = 5.0
    other = right.flip(1)
    assert (
        heat_loss(right, scan, row, column, torch.tensor([1]))
        < heat_loss(other, scan, row, column, torch.tensor([1])) - 1.0
    )
