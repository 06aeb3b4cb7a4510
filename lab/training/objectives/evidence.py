"""Losses of the field network and of the evidence network."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from models.perception.see.detections import CENTRE, CLASS, HEADING, LOG_SIZE, LOG_STD, LOG_STD_LIMITS, OBJECT, PLACE
from models.perception.see.wall_elements import BEYOND_M

#: Cells so near a wall's line are of the wall; up to so far they are neither.
WALL_M, NEAR_WALL_M = 0.3, 0.6
#: A wall cell counts as much as so many others.
WALL_WEIGHT = 3.0
#: Cells about a return that are asked for in part.
RETURN_REACH = 3
#: Width of an object's target, and how far from its place cells answer for it.
SIGMA_M, ANSWERS_M, IGNORED_M = 0.6, 1.0, 2.0
#: Weights of the parts of the loss of an object relative to that of existence.
CLASS_WEIGHT, PLACE_WEIGHT, SIZE_WEIGHT, HEADING_WEIGHT, CENTRE_WEIGHT = 0.1, 0.3, 0.1, 0.1, 0.1


def wall_loss(answer: Tensor, range_m: Tensor, angle_rad: Tensor, cell_range_m: Tensor) -> Tensor:
    """Return the loss of answers [B, 4, range, azimuth] against the first wall of each azimuth: its range (infinite:
    none) and angle [B, azimuth].
    """
    answer = answer.float()
    is_met = torch.isfinite(range_m)
    met_m = torch.where(is_met, range_m, 1e4)
    beyond_m = (cell_range_m[None, :, None] - met_m[:, None]) * torch.cos(angle_rad)[:, None]
    off_m = beyond_m.abs()
    wall, unsure = off_m <= WALL_M, (off_m > WALL_M) & (off_m < NEAR_WALL_M)
    weight = torch.where(wall, WALL_WEIGHT, torch.where(unsure, 0.0, 1.0))
    exists = functional.binary_cross_entropy_with_logits(answer[:, 0], wall.float(), weight=weight, reduction="sum")
    cells = wall.sum().clamp_min(1)
    turn = torch.stack([torch.cos(angle_rad), torch.sin(angle_rad)], dim=1)[:, :, None].expand(
        -1, -1, off_m.shape[1], -1
    )
    off = (answer[:, 1] - beyond_m / BEYOND_M).abs()
    turned = (answer[:, 2:4] - turn).abs().sum(dim=1)
    return exists / cells + torch.where(wall, off + 2.0 * turned, 0.0).sum() / cells


def heat_loss(logits: Tensor, scan: Tensor, row: Tensor, column: Tensor, path_class: Tensor) -> Tensor:
    """Return the focal loss of logits [B, classes, range, azimuth] against the returns of each scan, [N] each."""
    heat = torch.zeros_like(logits, dtype=torch.float32)
    _, classes, rows, columns = heat.shape
    flat = heat.view(-1)
    for down in range(-RETURN_REACH, RETURN_REACH + 1):
        for right in range(-RETURN_REACH, RETURN_REACH + 1):
            at_row, at_column = row + down, column + right
            inside = (at_row >= 0) & (at_row < rows) & (at_column >= 0) & (at_column < columns)
            index = (((scan * classes + path_class) * rows + at_row) * columns + at_column)[inside]
            value = math.exp(-0.5 * (down * down + right * right))
            flat.scatter_reduce_(0, index, torch.full_like(index, value, dtype=torch.float32), "amax")
    return existence_loss(logits.float(), heat)


@dataclass(frozen=True)
class EvidenceTargets:
    """What a batch holds: objects of all scans, N of them."""

    scan: Tensor
    place_m: Tensor
    centre_m: Tensor
    log_size: Tensor
    heading: Tensor
    object_class: Tensor
    asked: Tensor


def evidence_loss(answer: Tensor, targets: EvidenceTargets, toward: Tensor, x_m: Tensor, y_m: Tensor) -> Tensor:
    """Return the loss of answers [B, answers, x, y].

    `toward` [B, 2, x, y]: direction of the way on at each place by its likeliest mirror, along which errors are said.
    """
    answer = answer.float()
    batch = len(answer)
    heat = torch.zeros((batch, len(x_m), len(y_m)), device=answer.device)
    away2 = (x_m[None, :, None] - targets.place_m[:, 0, None, None]) ** 2
    away2 = away2 + (y_m[None, None, :] - targets.place_m[:, 1, None, None]) ** 2
    asked = targets.asked
    spread = torch.exp(-away2 / (2.0 * SIGMA_M**2))
    spread = torch.where(spread < 0.02, 0.0, spread).clamp_max(0.95)
    least = away2.flatten(1).min(dim=1).values[:, None, None]
    spread = torch.where((away2 <= least) & (least < 0.5), 1.0, spread)
    ignored = (away2 < IGNORED_M**2).float()
    heat = _largest_of_scan(heat, targets.scan[asked], spread[asked])
    hidden = _largest_of_scan(torch.zeros_like(heat), targets.scan[~asked], ignored[~asked])
    weight = torch.where((hidden > 0.0) & (heat <= 0.02), 0.0, 1.0)
    exists = existence_loss(answer[:, OBJECT.start], heat, weight)
    # the nearest object of each cell that answers for one
    nearest = torch.where(asked[:, None, None], away2, math.inf)
    number, x, y = torch.nonzero(nearest < ANSWERS_M**2, as_tuple=True)
    if not len(number):
        return exists
    scan = targets.scan[number]
    flat = (scan * len(x_m) + x) * len(y_m) + y
    best = torch.full((heat.numel(),), math.inf, device=answer.device)
    best.scatter_reduce_(0, flat, nearest[number, x, y], "amin")
    own = nearest[number, x, y] <= best[flat]
    number, x, y, scan = number[own], x[own], y[own], scan[own]
    said = answer[scan, :, x, y]
    cell_m = torch.stack([x_m[x], y_m[y]], dim=1)
    ray = toward[scan, :, x, y]
    ray = ray / ray.norm(dim=1, keepdim=True).clamp_min(1e-3)
    error_m = said[:, PLACE] - (targets.place_m[number] - cell_m)
    along = torch.stack([(error_m * ray).sum(1), error_m[:, 1] * ray[:, 0] - error_m[:, 0] * ray[:, 1]], dim=1)
    place = laplace_loss(along, said[:, LOG_STD], torch.zeros_like(along))
    parts = (
        (CLASS_WEIGHT, functional.cross_entropy(said[:, CLASS], targets.object_class[number])),
        (PLACE_WEIGHT, place),
        (SIZE_WEIGHT, (said[:, LOG_SIZE] - targets.log_size[number]).abs().mean()),
        (HEADING_WEIGHT, (said[:, HEADING] - targets.heading[number]).abs().mean()),
        (CENTRE_WEIGHT, (said[:, CENTRE] - (targets.centre_m - targets.place_m)[number]).abs().mean()),
    )
    return exists + sum((weight * part for weight, part in parts), torch.zeros((), device=answer.device))


def _largest_of_scan(base: Tensor, scan: Tensor, values: Tensor) -> Tensor:
    """Return in each scan's plane [B, x, y] the largest of its own among planes [N, x, y]."""
    return base.scatter_reduce(0, scan[:, None, None].expand_as(values), values, "amax")


def existence_loss(logits: Tensor, heat: Tensor, weight: Tensor | float = 1.0) -> Tensor:
    """Return the focal loss of logits against a target in 0..1 that is one at objects, per object; cells weighted.

    Cells beside an object count less: (1 - target)^4. (Law, Deng: CornerNet, Eq. (1).)
    """
    yes, no = functional.logsigmoid(logits), functional.logsigmoid(-logits)
    at_object = heat == 1.0
    hit = no.exp() ** 2 * yes
    miss = (1.0 - heat) ** 4 * yes.exp() ** 2 * no
    return -(torch.where(at_object, hit, miss) * weight).sum() / at_object.sum().clamp_min(1)


def laplace_loss(place_m: Tensor, log_std: Tensor, true_m: Tensor) -> Tensor:
    """Return the mean negative log likelihood of errors under Laplace's law of the standard deviations said.

    Its scale is std / sqrt(2): log(sqrt(2) std) + sqrt(2) |error| / std.
    """
    log_std = log_std.clamp(*LOG_STD_LIMITS)
    root = 2.0**0.5
    return (log_std + root * (place_m - true_m).abs() * torch.exp(-log_std)).mean()
