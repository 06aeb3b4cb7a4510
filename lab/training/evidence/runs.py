"""Runs of the field and the evidence network: samples of data sets, training, and the files that the vehicle loads.

Samples are made of the data sets, the field network is trained on them and exported, then the evidence network on what
both see. What is there already is kept, so that a run that was stopped goes on.
"""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from lab.training.data.evidence_store import CandidateTask, EvidenceTask, FieldTask, make_files
from lab.training.data.frames import DataSet
from lab.training.evidence.grid_training import GridEpoch, GridSchedule, GridTraining
from lab.training.evidence.train_candidates import CandidateTraining
from lab.training.evidence.train_evidence import EvidenceTraining
from lab.training.evidence.train_fields import FieldTraining
from lab.training.export.evidence import export_candidates, export_evidence, export_fields
from lab.training.export.onnx import write_card
from models.perception.cards import card_path, read_card
from models.perception.find.encoding import Encoding
from models.perception.find.onnx_model import DEFAULT_MODEL
from models.perception.see.candidate_predictor import CandidateCard, CandidateEncoding
from models.perception.see.evidence_predictor import EvidenceCard, EvidencePredictor
from models.perception.see.field_predictor import FieldCard
from models.perception.see.scan_evidence import EvidenceEncoding
from msgs.files.checksums import file_sha256
from msgs.values.radar import RangeAzimuthGrid

CHANNELS = ("level", "shadow", "contrast", "range", "azimuth", "level_real", "level_imaginary")
ENCODING, EVIDENCE, GRID = Encoding(channels=CHANNELS), EvidenceEncoding(), RangeAzimuthGrid()
#: Names of the files in the run folder.
FIELDS_FILE, EVIDENCE_FILE = "field_unet.onnx", "evidence_unet.onnx"

#: Takes in the name of a stage and its newest epoch.
Report = Callable[[str, GridEpoch], None]


@dataclass(frozen=True, kw_only=True)
class EvidenceRun:
    """What both networks are trained and judged on, where the run lies, and how samples are made.

    `init`: an exported evidence network, from which and from the field network beside it both go on; without it
    `field_start`: a detector (`compact_unet.onnx`) whose layers the field network begins with. `sample_minutes`: time
    for the training samples of each network; None: all are made.

    Raises `ValueError` where a place of the validation scans is trained on, or radars differ.
    """

    data: Sequence[Path]
    validation: Sequence[Path]
    folder: Path
    detector: Path = DEFAULT_MODEL
    field_start: Path | None = None
    init: Path | None = None
    workers: int = 1
    sample_minutes: float | None = None

    def __post_init__(self) -> None:
        _check_sets(self.data, self.validation)

    def train_fields(self, schedule: GridSchedule, report: Report = lambda *_: None) -> FieldCard:
        """Train and export the field network; raises `ValueError` for a start of another shape."""
        task = FieldTask(ENCODING)
        judges, train = self._samples(task, "fields")
        folder = self.folder / "fields"
        training = FieldTraining(train, judges, CHANNELS, GRID, schedule, folder)
        if self.init is not None:
            fields = EvidencePredictor(self.init).fields_path
            training.start_from(fields, read_card(card_path(fields), FieldCard).sha256)
        elif self.field_start is not None:
            training.start_from_detector(self.field_start)
        best = training.run(lambda epoch: report("fields", epoch))
        return export_fields(folder, ENCODING, GRID, self.folder / FIELDS_FILE, **self._facts(training, best))

    def take_fields(self, path: Path) -> None:
        """Take an exported field network in place of training one."""
        self.folder.mkdir(parents=True, exist_ok=True)
        target = self.folder / FIELDS_FILE
        for own, other in ((target, path), (card_path(target), card_path(path))):
            shutil.copyfile(other, own)

    def train_evidence(self, schedule: GridSchedule, report: Report = lambda *_: None) -> EvidenceCard:
        """Train and export the evidence network by the field network in the run folder."""
        fields = self.folder / FIELDS_FILE
        judges, train = self._samples(EvidenceTask(EVIDENCE, self.detector, fields), "evidence")
        folder = self.folder / "evidence"
        training = EvidenceTraining(train, judges, EVIDENCE, GRID, schedule, folder)
        if self.init is not None:
            training.start_from(self.init, read_card(card_path(self.init), EvidenceCard).sha256)
        best = training.run(lambda epoch: report("evidence", epoch))
        facts = self._facts(training, best)
        facts["data"] |= {
            "fields": FIELDS_FILE,
            "fields_sha256": file_sha256(fields),
            "detector": self.detector.name,
            "detector_sha256": file_sha256(self.detector),
        }
        threshold = best.scores["threshold"]
        return export_evidence(folder, EVIDENCE, self.folder / EVIDENCE_FILE, threshold=threshold, **facts)

    def _samples(self, task: FieldTask | EvidenceTask, name: str) -> tuple[list[Path], list[Path]]:
        """Return files of samples of the validation scans and of the training scans."""
        folder = self.folder / f"{name}-samples"
        return _sample_files(self.data, self.validation, task, folder, self.workers, self.sample_minutes)

    def _facts(self, training: GridTraining, best: GridEpoch) -> dict[str, Any]:
        """Return what a card says of a run."""
        start = {} if self.init is None else {"start": f"{self.init.name}, sha256 {file_sha256(self.init)}"}
        facts = _facts(training, best, self.data, self.validation)
        return facts | {"training": facts["training"] | start}


@dataclass(frozen=True, kw_only=True)
class CandidateRun:
    """What the candidate network of an exported evidence network is trained and judged on; as `EvidenceRun`."""

    network: Path
    data: Sequence[Path]
    validation: Sequence[Path]
    folder: Path
    detector: Path = DEFAULT_MODEL
    workers: int = 1

    def __post_init__(self) -> None:
        _check_sets(self.data, self.validation)

    @property
    def file(self) -> Path:
        """The candidate network's, beside the evidence network."""
        return self.network.with_name(f"candidates_of_{self.network.stem.replace('.', '_')}.onnx")

    def train(self, schedule: GridSchedule, report: Callable[[GridEpoch], None] = lambda _: None) -> CandidateCard:
        """Train and export the candidate network, and name it in the card of the evidence network."""
        predictor = EvidencePredictor(self.network)
        encoding = CandidateEncoding(evidence=predictor.card.encoding)
        evidence = EvidenceTask(encoding.evidence, self.detector, predictor.fields_path)
        task = CandidateTask(encoding, self.network, evidence)
        folder = self.folder / "candidate-samples"
        # of other imperfect radars than the evidence network's: its answers to what it has learned are too sure
        judges, train = _sample_files(self.data, self.validation, task, folder, self.workers, seed=1)
        training = CandidateTraining(train, judges, encoding, predictor.grid, schedule, self.folder)
        best = training.run(report)
        facts = _facts(training, best, self.data, self.validation)
        facts["data"] |= {"evidence": self.network.name, "evidence_sha256": predictor.card.sha256}
        facts["data"] |= {"detector": self.detector.name, "detector_sha256": file_sha256(self.detector)}
        card = export_candidates(self.folder, encoding, self.file, **facts)
        names = {"candidates": self.file.name, "candidates_sha256": card.sha256}
        write_card(msgspec.structs.replace(predictor.card, data={**predictor.card.data, **names}), self.network)
        return card


def _check_sets(train: Sequence[Path], validation: Sequence[Path]) -> None:
    """Raise `ValueError` for sets of different radars, or where a place of the validation scans is trained on."""
    sets, judges = list(map(DataSet, train)), list(map(DataSet, validation))
    for data in (*sets, *judges):
        if (data.grid, data.setup) != (sets[0].grid, sets[0].setup):
            raise ValueError(f"{data.directory}: radar and grid must be those of {sets[0].directory}")
    _refuse_shared_places(sets, judges)


def _sample_files(
    data: Sequence[Path],
    validation: Sequence[Path],
    task: FieldTask | EvidenceTask | CandidateTask,
    folder: Path,
    workers: int,
    minutes: float | None = None,
    seed: int = 0,
) -> tuple[list[Path], list[Path]]:
    """Return files of samples of the validation scans and of the training scans, by an imperfect radar for half."""
    judges = sorted(make_files(validation, task, folder, None, workers))
    started, train = time.monotonic(), []
    for path in make_files(data, task, folder, seed, workers):
        train.append(path)
        if time.monotonic() - started > 60.0 * (minutes or math.inf):
            break
    return judges, sorted(train)


def _facts(training: GridTraining, best: GridEpoch, data: Sequence[Path], validation: Sequence[Path]) -> dict[str, Any]:
    """Return what a card says of a run."""
    schedule = {name: getattr(training.schedule, name) for name in training.schedule.__dataclass_fields__}
    sets = {"train": data, "validation": validation}
    return {
        "scores": best.scores,
        "data": {name: " ".join(path.name for path in paths) for name, paths in sets.items()},
        "training": {"scans": training.scans, "seconds": round(best.seconds), "schedule": schedule},
    }


def _refuse_shared_places(train: Sequence[DataSet], validation: Sequence[DataSet]) -> None:
    """Raise `ValueError` where a place or drive of the validation scans is trained on."""
    trained = {
        item: data.directory
        for data in reversed(train)
        for index in range(len(data))
        for item in data.identity(index).items()
    }
    for data in validation:
        for index in range(len(data)):
            for kind, value in data.identity(index).items():
                if (kind, value) in trained:
                    raise ValueError(
                        f"{data.directory}: no scan may share a place with {trained[kind, value]}, scan {index} does "
                        f"(same {kind})"
                    )
