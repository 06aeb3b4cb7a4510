"""Export of trained field and evidence networks to the files and cards that the vehicle loads."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import torch
from scipy.special import expit
from torch import nn

from lab.networks.candidate_net import CandidateNet
from lab.networks.compact_unet import CompactUNet
from lab.networks.evidence_unet import EvidenceUNet
from lab.training.data.frames import DataSet
from lab.training.evidence.train_fields import field_network
from lab.training.export.onnx import require_onnx, write_card, write_onnx
from lab.training.export.quantize import quantize_int8
from lab.training.run_folder import BEST, load_state
from models.perception.cards import card_path, read_card
from models.perception.find.detectors import NetworkDetector
from models.perception.find.encoding import Encoding, encode_map
from models.perception.find.onnx_model import DEFAULT_MODEL
from models.perception.mirrors.peaks_to_view import GeometryParams, direct_structure
from models.perception.onnx_session import open_session
from models.perception.see.candidate_predictor import FACTS, CandidateCard, CandidateEncoding
from models.perception.see.detections import ANSWERS
from models.perception.see.evidence_predictor import EvidenceCard, EvidencePredictor
from models.perception.see.field_predictor import FieldCard, FieldPredictor
from models.perception.see.scan_evidence import EvidenceEncoding, scan_evidence
from msgs.files.checksums import file_sha256
from msgs.values.radar import RangeAzimuthGrid

#: Largest difference of an answer between torch and ONNX Runtime, relative to the largest answer.
PARITY = 1e-4

Card = TypeVar("Card", FieldCard, EvidenceCard)


def export_fields(
    run_dir: Path, encoding: Encoding, grid: RangeAzimuthGrid, model_path: Path, **said: Any
) -> FieldCard:
    """Export the best field network of a run and write its card; `said` are the card's further fields.

    Raises `ValueError` if the folder holds none, or where the file answers otherwise than torch.
    """
    require_onnx(model_path)
    network = CompactUNet(field_network(len(encoding.channels)))
    epoch = _load(network, run_dir)
    _write(network, encoding.shape, model_path)
    answer = (network.config.classes, encoding.range_bins, grid.azimuth_bins)
    card = FieldCard(encoding=encoding, grid=grid, **_facts(network, model_path, encoding.shape, answer, epoch, said))
    write_card(card, model_path)
    return card


def export_evidence(run_dir: Path, encoding: EvidenceEncoding, model_path: Path, **said: Any) -> EvidenceCard:
    """Export the best evidence network of a run and write its card; as `export_fields`."""
    require_onnx(model_path)
    network = EvidenceUNet(encoding.shape[0], ANSWERS)
    epoch = _load(network, run_dir)
    _write(network, encoding.shape, model_path)
    facts = _facts(network, model_path, encoding.shape, (ANSWERS, *encoding.grid.shape), epoch, said)
    card = EvidenceCard(encoding=encoding, **facts)
    write_card(card, model_path)
    return card


def export_candidates(run_dir: Path, encoding: CandidateEncoding, model_path: Path, **said: Any) -> CandidateCard:
    """Export the best candidate network of a run, for any number of candidates, and write its card; as
    `export_fields`.
    """
    require_onnx(model_path)
    shapes = encoding.shapes
    network = CandidateNet(shapes["places"][0], FACTS)
    epoch = _load(network, run_dir)
    write_candidate_network(network, encoding, model_path)
    rng = np.random.default_rng(0)
    inputs = {name: rng.uniform(-1.0, 1.0, (3, *shape)).astype(np.float32) for name, shape in shapes.items()}
    with torch.no_grad():
        wanted = network(*map(torch.from_numpy, inputs.values())).numpy()
    said_of = open_session(model_path, file_sha256(model_path), 1).run(None, inputs)[0]
    _check_parity(said_of, wanted, model_path)
    card = CandidateCard(encoding=encoding, **_own_facts(network, model_path, epoch, said))
    write_card(card, model_path)
    return card


def write_candidate_network(network: nn.Module, encoding: CandidateEncoding, path: Path) -> None:
    """Write a candidate network as ONNX, for any number of candidates."""
    shapes = encoding.shapes
    write_onnx(
        network,
        tuple(torch.zeros(2, *shape) for shape in shapes.values()),
        path,
        input_names=list(shapes),
        output_names=["correction"],
        dynamic_axes={name: {0: "candidates"} for name in (*shapes, "correction")},
    )


def quantize_evidence(source: Path, data: DataSet, count: int, model_path: Path) -> EvidenceCard:
    """Write an exported evidence network and its field network, beside it, in 8-bit integers, their ranges set on the
    first `count` scans of a data set that they were trained on; threshold and tables are those of the source. A field
    network that is rounded already stays as it is.

    Raises `ValueError` naming a source that is no evidence network, or a data set of another radar.
    """
    require_onnx(model_path)
    exact = EvidencePredictor(source)
    card, fields_path = exact.card, exact.fields_path
    maps = [frame.ra_map for frame in data.frames(range(min(count, len(data))))]
    command = f"mirrorwave export {source} --precision int8 --data {data.directory} --out {model_path}"
    fields, rounded_path = read_card(card_path(fields_path), FieldCard), fields_path
    if "quantized" not in fields.training:
        rounded_path = model_path.with_name(f"{fields_path.stem}.int8.onnx")
        quantize_int8(fields_path, rounded_path, np.stack([encode_map(fields.encoding, ra_map) for ra_map in maps]))
        write_card(_rounded(fields, rounded_path, command), rounded_path)
    detector, rounded = NetworkDetector(data.setup, DEFAULT_MODEL), FieldPredictor(rounded_path)
    geometry = GeometryParams(walls=card.encoding.walls)
    inputs = []
    for ra_map in maps:
        _, walls = direct_structure(detector.detect(ra_map), geometry)
        inputs.append(scan_evidence(card.encoding, ra_map, rounded.answer(ra_map), walls).evidence.channels)
    quantize_int8(source, model_path, np.stack(inputs))
    # its candidates are others: they are to be learned by themselves
    kept = {name: value for name, value in card.data.items() if not name.startswith("candidates")}
    names = {"fields": rounded_path.name, "fields_sha256": rounded.card.sha256}
    card = msgspec.structs.replace(_rounded(card, model_path, command), data={**kept, **names})
    write_card(card, model_path)
    predictor = EvidencePredictor(model_path)
    answers = [[expit(network.answer(channels)[0]) for channels in inputs] for network in (exact, predictor)]
    difference = float(np.abs(np.array(answers[0]) - np.array(answers[1])).max())
    card = msgspec.structs.replace(card, scores={"largest_probability_difference": round(difference, 4)})
    write_card(card, model_path)
    return card


def _rounded(card: Card, path: Path, command: str) -> Card:
    """Return the card of a network written anew."""
    training = {**card.training, "quantized": {"command": command, "source_sha256": card.sha256}}
    return msgspec.structs.replace(card, name=path.stem, sha256=file_sha256(path), training=training, scores={})


def _load(network: nn.Module, run_dir: Path) -> int:
    state = load_state(run_dir / BEST)
    network.load_state_dict(state["network"])
    network.eval()
    return int(state["epoch"])


def _write(network: nn.Module, shape: tuple[int, ...], path: Path) -> None:
    write_onnx(network, (torch.zeros(1, *shape),), path, input_names=["cells"], output_names=["answer"])
    cells = np.random.default_rng(0).uniform(-1.0, 1.0, (1, *shape)).astype(np.float32)
    with torch.no_grad():
        wanted = network(torch.from_numpy(cells)).numpy()
    said = open_session(path, file_sha256(path), 1).run(None, {"cells": cells})[0]
    _check_parity(said, wanted, path)


def _check_parity(said: np.ndarray, wanted: np.ndarray, path: Path) -> None:
    """Raise `ValueError` for a file whose answers differ from torch's."""
    difference = float(np.abs(said - wanted).max() / max(np.abs(wanted).max(), np.finfo(np.float32).tiny))
    if not difference <= PARITY:
        raise ValueError(f"{path}: answers must agree with torch within {PARITY}, differ by {difference}")


def _facts(
    network: nn.Module, path: Path, shape: tuple[int, ...], answer: tuple[int, ...], epoch: int, said: dict[str, Any]
) -> dict[str, Any]:
    return _own_facts(network, path, epoch, said) | {"input_shape": (1, *shape), "output_shape": (1, *answer)}


def _own_facts(network: nn.Module, path: Path, epoch: int, said: dict[str, Any]) -> dict[str, Any]:
    training = {"chosen_epoch": epoch} | said.pop("training", {})
    parameters = sum(parameter.numel() for parameter in network.parameters())
    return {"name": path.stem, "sha256": file_sha256(path), "parameters": parameters, "training": training} | said
