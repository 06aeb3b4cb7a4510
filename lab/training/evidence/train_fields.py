"""Training of the field network: in each cell of the map the first wall of its direction, and the returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lab.networks.compact_unet import CompactUNet, CompactUNetConfig
from lab.training.data.field_samples import Returns
from lab.training.evidence.grid_training import GridSchedule, GridTraining
from lab.training.exported_weights import load_exported
from lab.training.objectives.evidence import heat_loss, wall_loss
from models.perception.see.field_predictor import FIELD_ANSWERS
from models.perception.see.wall_elements import BEYOND_M, WALL_ANSWERS
from msgs.files.array_files import load_arrays
from msgs.values.array_table import stored_tables
from msgs.values.radar import RangeAzimuthGrid

#: A direction's wall is found if its likeliest cell lies so near to it, and is turned like it.
FOUND_M, FOUND_COS = 0.5, 0.985


@dataclass(frozen=True)
class _Arrays:
    """Samples on the device: inputs, first walls of each azimuth, returns of each scan."""

    cells: Tensor
    range_m: Tensor
    angle_rad: Tensor
    returns: list[Returns]


class FieldTraining(GridTraining):
    """A run on sample files (`evidence_store.FieldTask`)."""

    def __init__(
        self,
        train: Sequence[Path],
        validation: Sequence[Path],
        channels: Sequence[str],
        grid: RangeAzimuthGrid,
        schedule: GridSchedule,
        run_dir: Path,
    ) -> None:
        torch.manual_seed(schedule.seed)
        network = CompactUNet(field_network(len(channels)))
        super().__init__(network, schedule, run_dir)
        self._odd = [index for index, name in enumerate(channels) if name == "azimuth"]
        self._train, self._validation = self._loaded(train), self._loaded(validation)
        bins = self._train.cells.shape[2]
        self._cell_range_m = torch.from_numpy(grid.range_at(np.arange(bins))).float().to(self.device)

    def _loaded(self, paths: Sequence[Path]) -> _Arrays:
        files = [load_arrays(path) for path in paths]
        cells, range_m, angle_rad = (
            torch.from_numpy(np.concatenate([file[name] for file in files])).to(self.device)
            for name in ("cells", "range_m", "angle_rad")
        )
        returns = [table for file in files for table in stored_tables(Returns, "returns", file)]
        return _Arrays(cells, range_m, angle_rad, returns)

    def start_from_detector(self, detector: Path) -> None:
        """Begin with the layers and the two answers of an exported detector (`compact_unet.onnx`), in a run without an
        epoch; raises `ValueError` naming a file of another shape.
        """
        if self.reports:
            return
        source = CompactUNet(CompactUNetConfig(in_channels=self._train.cells.shape[1]))
        load_exported(source, detector)
        state = self.network.state_dict()
        for name, values in source.state_dict().items():
            # its answers are the last ones here
            state[name] = torch.cat([state[name][: -len(values)], values]) if name.startswith("head.") else values
        self.network.load_state_dict(state)
        self.settle()

    def inputs(self, index: Tensor) -> Tensor:
        """Return the cells of some training scans."""
        return self._train.cells[index.to(self.device)].float()

    @property
    def scans(self) -> int:
        """Training scans."""
        return len(self._train.cells)

    def batch_loss(self, index: Tensor, flip: bool) -> Tensor:
        """Return the loss of some training scans."""
        return self._loss(self._train, index, flip)[0]

    def _loss(self, arrays: _Arrays, index: Tensor, flip: bool) -> tuple[Tensor, Tensor]:
        at = index.to(self.device)
        cells, range_m, angle_rad = arrays.cells[at].float(), arrays.range_m[at], arrays.angle_rad[at]
        own = [arrays.returns[item] for item in index.tolist()]
        number = np.repeat(np.arange(len(own)), [len(table.row) for table in own])
        joined = Returns.joined(own)
        values = (number, joined.row, joined.column, joined.path_class)
        scan, row, column, path_class = (torch.from_numpy(array).to(self.device) for array in values)
        if flip:
            cells, range_m, angle_rad = cells.flip(3), range_m.flip(1), -angle_rad.flip(1)
            cells[:, self._odd] *= -1.0
            column = range_m.shape[1] - 1 - column
        answer = self.forward(cells)
        walls = wall_loss(answer[:, :WALL_ANSWERS], range_m, angle_rad, self._cell_range_m)
        return walls + heat_loss(answer[:, WALL_ANSWERS:], scan, row, column, path_class), answer

    def validate(self) -> tuple[float, dict[str, float]]:
        """Return the loss, and the shares of directions whose wall is found, and whose likeliest wall is there."""
        losses, hits, walls, said = [], 0, 0, 0
        with torch.no_grad():
            for first in range(0, len(self._validation.cells), self.schedule.batch_size):
                index = torch.arange(first, min(first + self.schedule.batch_size, len(self._validation.cells)))
                loss, answer = self._loss(self._validation, index, False)
                losses.append(loss.item())
                right, is_wall, is_said = self._judged(answer.float(), index.to(self.device))
                hits += int((right & is_said).sum())
                walls += int(is_wall.sum())
                said += int(is_said.sum())
        scores = {"recall": hits / max(walls, 1), "precision": hits / max(said, 1)}
        return float(np.mean(losses)), scores

    def _judged(self, answer: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        range_m, angle_rad = self._validation.range_m[index], self._validation.angle_rad[index]
        cell = answer[:, 0].argmax(dim=1, keepdim=True)
        logit, beyond, cosine, sine = (answer[:, k].gather(1, cell)[:, 0] for k in range(WALL_ANSWERS))
        said_rad = torch.atan2(sine, cosine)
        foot_m = self._cell_range_m[cell[:, 0]] * torch.cos(said_rad) - BEYOND_M * beyond
        is_wall = torch.isfinite(range_m) & (range_m < self._cell_range_m[-1])
        off_m = foot_m - torch.where(is_wall, range_m, 1e4) * torch.cos(angle_rad)
        right = is_wall & (off_m.abs() < FOUND_M) & (torch.cos(said_rad - angle_rad) > FOUND_COS)
        return right, is_wall, logit > -1.0


def field_network(channels: int) -> CompactUNetConfig:
    """Return the shape of a field network with so many input channels."""
    return replace(CompactUNetConfig(), in_channels=channels, classes=FIELD_ANSWERS, head_bias=-3.0)
