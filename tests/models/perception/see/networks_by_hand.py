"""Field and evidence networks worked out by hand: no walls, and an object wherever a mirror shows an echo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lab.training.export.onnx import write_card, write_onnx
from models.perception.find.encoding import Encoding
from models.perception.see.detections import ANSWERS, CLASS, CLASSES
from models.perception.see.evidence_predictor import EvidenceCard
from models.perception.see.field_predictor import FIELD_ANSWERS, FieldCard
from models.perception.see.gathering import channel_names
from models.perception.see.scan_evidence import EvidenceEncoding
from msgs.files.checksums import file_sha256
from msgs.values.frames import polar_from_xy
from msgs.values.radar import RangeAzimuthGrid, RangeAzimuthMap

GRID = RangeAzimuthGrid()
FIELDS, EVIDENCE = Encoding(), EvidenceEncoding()
NOISE_MW = 1e-14


class _Fields(torch.nn.Module):
    """Says no everywhere, on the columns of the map."""

    def __init__(self) -> None:
        super().__init__()
        self.answer = torch.nn.Conv2d(FIELDS.shape[0], 8 * FIELD_ANSWERS, 1)
        with torch.no_grad():
            self.answer.weight.zero_()
            self.answer.bias.fill_(-20.0)

    def forward(self, cells: torch.Tensor) -> torch.Tensor:
        count, _, rows, columns = cells.shape
        by_column = self.answer(cells).reshape(count, FIELD_ANSWERS, 8, rows, columns).permute(0, 1, 3, 4, 2)
        return by_column.reshape(count, FIELD_ANSWERS, rows, 8 * columns)


def evidence_network(folder: Path, gain: float = 25.0, name: str = "by_hand") -> Path:
    """Write a network that calls a place an object, a car with an error of 1 m, by the level of its first mirror:
    a logit of -10 + `gain` of it.
    """
    layer = torch.nn.Conv2d(EVIDENCE.shape[0], ANSWERS, 1)
    with torch.no_grad():
        layer.weight.zero_()
        layer.bias.zero_()
        layer.bias[0] = -10.0
        layer.weight[0, channel_names(EVIDENCE.mirrors).index("level_0")] = gain
        layer.bias[CLASS.start + CLASSES.index("car")] = 1.0
    return written(folder, layer, name)


def written(folder: Path, network: torch.nn.Module, name: str) -> Path:
    """Write an evidence network with its card, and its field network beside it."""
    names = {"input_names": ["cells"], "output_names": ["answer"]}
    fields, path = folder / "fields.onnx", folder / f"{name}.onnx"
    write_onnx(_Fields(), (torch.zeros(1, *FIELDS.shape),), fields, **names)  # type: ignore[arg-type]
    shape = (1, FIELD_ANSWERS, FIELDS.range_bins, GRID.azimuth_bins)
    write_card(
        FieldCard(
            name="fields", sha256=file_sha256(fields), parameters=0, encoding=FIELDS, grid=GRID,
            input_shape=(1, *FIELDS.shape), output_shape=shape,
        ),
        fields,
    )  # fmt: skip
    write_onnx(network, (torch.zeros(1, *EVIDENCE.shape),), path, **names)  # type: ignore[arg-type]
    write_card(
        EvidenceCard(
            name=name, sha256=file_sha256(path), parameters=0, encoding=EVIDENCE, threshold=0.5,
            input_shape=(1, *EVIDENCE.shape), output_shape=(1, ANSWERS, *EVIDENCE.grid.shape),
            data={"fields": fields.name, "fields_sha256": file_sha256(fields)},
        ),
        path,
    )  # fmt: skip
    return path


def empty_map(**values: object) -> RangeAzimuthMap:
    """A map of no echoes, whose columns were measured a millisecond after each other."""
    plain = {
        "stamp_ns": 0, "scan_id": 0, "values": np.full(GRID.shape, 1e-9, np.complex64), "noise_power_mw": NOISE_MW,
        "azimuth_stamp_ns": np.arange(GRID.azimuth_bins) * 1_000_000, "incoherent": np.zeros(GRID.range_bins, bool),
    }  # fmt: skip
    return RangeAzimuthMap(**plain | values)  # type: ignore[arg-type]


def echoes(*places_m: tuple[float, float], snr_db: float = 60.0) -> np.ndarray:
    """Values of a map with echoes at places of its plane."""
    values = np.full(GRID.shape, 1e-9, np.complex64)
    range_m, azimuth_rad = polar_from_xy(np.array(places_m))
    row, column = np.rint(GRID.range_index(range_m)).astype(int), np.rint(GRID.azimuth_index(azimuth_rad)).astype(int)
    values[row, column] = np.sqrt(NOISE_MW * 10.0 ** (snr_db / 10.0))
    return values
