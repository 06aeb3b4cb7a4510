"""Samples of the field and evidence networks on disk: made once by worker processes; evidence stays on disk until a
batch asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lab.training.data.candidate_samples import CandidateSamples, candidate_samples
from lab.training.data.evidence_samples import SCALE, EvidenceObjects, evidence_objects, quantized
from lab.training.data.field_samples import field_sample
from lab.training.data.frames import DataSet, Frame, FrameLabels, Scan
from lab.training.data.samples import Perturbation, perturb_scan
from lab.training.data.stored_truth import ScanTruth
from models.perception.find.detectors import NetworkDetector
from models.perception.find.encoding import Encoding
from models.perception.mirrors.mirror_table import WallArrays
from models.perception.mirrors.observability import observability
from models.perception.mirrors.peaks_to_view import GeometryParams, direct_structure, joined_by_priors
from models.perception.see.candidate_predictor import CandidateEncoding, candidate_inputs
from models.perception.see.detections import hidden_objects
from models.perception.see.evidence_answers import detections_of
from models.perception.see.evidence_predictor import EvidencePredictor
from models.perception.see.field_predictor import FieldPredictor
from models.perception.see.scan_evidence import EvidenceEncoding, ScanEvidence, scan_evidence
from models.perception.see.wall_memory import RadarPose, WallMemory
from models.perception.track.wall_fusion import PlacedPrior
from models.perception.track.wall_priors import WallPriorStore
from msgs.files.array_files import load_arrays
from msgs.files.whole_files import whole
from msgs.values.array_table import stored_columns, stored_tables
from msgs.values.environment import WallPriors
from msgs.values.frames import Pose2
from msgs.values.perception import TruthObject
from sim_player.dataset.executors import map_jobs

#: Scans of one file.
SAMPLES_PER_FILE = 40
#: Share of the training scans that an imperfect radar records.
IMPERFECT_SHARE = 0.5
#: Share of the training scans and drives with the walls of a poor map, and of these with a map that lies elsewhere.
MAP_SHARE, MISPLACED_SHARE = 0.2, 0.2
#: Standard deviation of where such a map lies, in both axes and of its heading.
MISPLACED_M, MISPLACED_RAD = 1.0, math.radians(1.5)


@dataclass(frozen=True)
class FieldTask:
    """Samples of the field network: its input."""

    encoding: Encoding


@dataclass(frozen=True)
class EvidenceTask:
    """Samples of the evidence network: its input, and the networks that it is made with."""

    encoding: EvidenceEncoding
    detector: Path
    fields: Path
    #: Detector and field network look at a scan and at its mirror image.
    flip_test: bool = False

    @property
    def geometry(self) -> GeometryParams:
        """How walls are fitted."""
        return GeometryParams(walls=self.encoding.walls)


@dataclass(frozen=True)
class CandidateTask:
    """Samples of the candidate network: its input, the evidence network, and how that network's samples are made."""

    encoding: CandidateEncoding
    network: Path
    evidence: EvidenceTask

    def of_file(self, number: int) -> CandidateTask:
        """Return the task of a file: in every other one all networks look at a scan and at its mirror image, so that
        the candidate network serves with and without.
        """
        return replace(self, evidence=replace(self.evidence, flip_test=number % 2 == 1))


def make_files(
    directories: Sequence[Path],
    task: FieldTask | EvidenceTask | CandidateTask,
    folder: Path,
    seed: int | None,
    workers: int,
) -> Iterator[Path]:
    """Yield files of the samples of all scans of some data sets as they are there, made by worker processes where they
    are missing; with a seed, half of the scans are recorded by an imperfect radar.

    Raises `ValueError` where a scan does not say its objects.
    """
    jobs = []
    for directory in directories:
        count = len(DataSet(directory))
        for number, first in enumerate(range(0, count, SAMPLES_PER_FILE)):
            path = folder / directory.name / f"samples-{number:05d}.npz"
            if path.exists():
                yield path
            else:
                jobs.append((directory, range(first, min(first + SAMPLES_PER_FILE, count)), task, path, seed))
    yield from map_jobs(_make_file, jobs, workers=workers)


def _make_file(job: tuple[Path, Sequence[int], FieldTask | EvidenceTask | CandidateTask, Path, int | None]) -> Path:
    directory, indices, task, path, seed = job
    data = _data_set(directory)
    frames = (_frame(data, index, seed) for index in indices)
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(task, FieldTask):
        arrays = _field_arrays(frames, task)
    elif isinstance(task, CandidateTask):
        arrays = _candidate_arrays(frames, task.of_file(indices[0] // SAMPLES_PER_FILE), directory, seed)
    else:
        channels, arrays = _evidence_arrays(frames, task, directory, seed)
        with whole(_channels_path(path)) as part, part.open("wb") as file:
            np.save(file, channels)
    with whole(path) as part, part.open("wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]
    return path


def _channels_path(path: Path) -> Path:
    return path.with_suffix(".channels.npy")


@lru_cache(maxsize=4)
def _data_set(directory: Path) -> DataSet:
    return DataSet(directory)


@lru_cache(maxsize=2)
def _networks(task: EvidenceTask, directory: Path) -> tuple[NetworkDetector, FieldPredictor]:
    detector = NetworkDetector(_data_set(directory).setup, task.detector, flip_test=task.flip_test)
    return detector, FieldPredictor(task.fields, flip_test=task.flip_test)


def _frame(data: DataSet, index: int, seed: int | None) -> Frame:
    rng = np.random.default_rng((seed or 0, index))
    imperfect = seed is not None and rng.random() < IMPERFECT_SHARE

    def recorded(scan: Scan) -> Scan:
        return perturb_scan(scan, Perturbation(), rng, data.setup) if imperfect else scan

    return data.frame(index, recorded)


def _field_arrays(frames: Iterator[Frame], task: FieldTask) -> dict[str, np.ndarray]:
    cells, walls, returns = zip(*(field_sample(frame, task.encoding) for frame in frames), strict=True)
    return {
        "cells": np.stack(cells),
        "range_m": np.stack([first.range_m for first in walls]),
        "angle_rad": np.stack([first.angle_rad for first in walls]),
        **stored_columns("returns", returns),
    }


def _evidence_arrays(
    frames: Iterator[Frame], task: EvidenceTask, directory: Path, seed: int | None
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the channels of some scans, int8 [scans, channels, x, y], and their objects and truths."""
    channels, objects, truths = [], [], []
    for frame, scan, truth in _scans(frames, task, directory, seed):
        channels.append(quantized(scan.evidence.channels))
        objects.append(evidence_objects(frame, scan))
        truths.append(truth)
    return np.stack(channels), stored_columns("objects", objects) | _truth_arrays(truths)


def _candidate_arrays(
    frames: Iterator[Frame], task: CandidateTask, directory: Path, seed: int | None
) -> dict[str, np.ndarray]:
    """Return the candidates of some scans and their truths."""
    predictor, encoding = _evidence_predictor(task.network, task.evidence.flip_test), task.encoding
    grid, azimuth_rad = encoding.evidence.grid, predictor.grid.azimuth_at(np.arange(predictor.grid.azimuth_bins))
    samples, truths = [], []
    for _, scan, truth in _scans(frames, task.evidence, directory, seed):
        channels = quantized(scan.evidence.channels).astype(np.float32) / SCALE
        answer = predictor.answer(channels)
        proposals = encoding.candidates(answer, truth.mirror, truth.walls)
        inputs = candidate_inputs(encoding, proposals, truth.walls, channels, answer, truth.ego_compensated)
        reports = detections_of(proposals, grid, truth.walls)
        stamp_ns = np.interp(reports.azimuth_rad, azimuth_rad, truth.azimuth_stamp_ns)
        measured = hidden_objects(reports, np.rint(stamp_ns).astype(np.int64))
        samples.append(candidate_samples(proposals, inputs, measured, truth))
        truths.append(truth)
    return stored_columns("candidates", samples) | _truth_arrays(truths)


@lru_cache(maxsize=2)
def _evidence_predictor(network: Path, flip_test: bool) -> EvidencePredictor:
    return EvidencePredictor(network, flip_test=flip_test)


def _scans(
    frames: Iterator[Frame], task: EvidenceTask, directory: Path, seed: int | None
) -> Iterator[tuple[Frame, ScanEvidence, ScanTruth]]:
    """Yield scans, their evidence and their truth; those of a drive share a memory."""
    detector, fields = _networks(task, directory)
    memory, drive = WallMemory(), ""
    for frame in frames:
        if frame.sequence != drive:
            memory, drive = WallMemory(), frame.sequence
        memory.move(RadarPose(0, frame.pose) if frame.sequence and frame.pose else None)
        peaks, geometry = detector.detect(frame.ra_map), task.geometry
        returns, fitted = direct_structure(peaks, geometry)
        mask = observability(fitted, peaks.sensitivity_db, geometry.grid, geometry.visibility)
        answer = fields.answer(frame.ra_map)
        priors = [] if seed is None else _poor_map(frame, seed)
        wall_prior = partial(WallPriorStore().fused, priors)
        with_priors = partial(joined_by_priors, peaks, returns, wall_prior) if priors else None
        scan = scan_evidence(task.encoding, frame.ra_map, answer, fitted, memory.earlier(), with_priors)
        memory.add(scan.elements)
        yield frame, scan, _truth(frame, scan.arrays, scan.evidence.mirror, mask)


def _truth_arrays(truths: Sequence[ScanTruth]) -> dict[str, np.ndarray]:
    """Return the truths of some scans as arrays."""
    arrays = {
        "visibility": np.stack([truth.visibility for truth in truths]),
        "mirror": np.stack([truth.mirror for truth in truths]).astype(np.int8),
        "truth": np.array([msgspec.json.encode(truth.truth) for truth in truths]),
    }
    arrays |= stored_columns("walls", [truth.walls for truth in truths])
    arrays |= stored_columns("labels", [truth.labels for truth in truths])
    for name in ("noise_power_mw", "azimuth_stamp_ns", "ego_compensated"):
        arrays[name] = np.array([getattr(truth, name) for truth in truths])
    return arrays


def _poor_map(frame: Frame, seed: int) -> list[PlacedPrior]:
    """Return the walls that a poor map has of a scan, for a share of the scans and of the drives; none for others."""
    rng = np.random.default_rng((seed, *(frame.sequence or str(frame.index)).encode()))
    if rng.random() >= MAP_SHARE:
        return []
    move = Pose2()
    if rng.random() < MISPLACED_SHARE:
        x_m, y_m = rng.normal(0.0, MISPLACED_M, 2).tolist()
        move = Pose2(x_m=x_m, y_m=y_m, yaw_rad=float(rng.normal(0.0, MISPLACED_RAD)))
    store = WallPriorStore()
    store.add(WallPriors(stamp_ns=0, source="map", walls=frame.map_walls))
    return store.at(0, lambda _: None, move.inverse())


def _truth(frame: Frame, walls: WallArrays, mirror: np.ndarray, mask: np.ndarray) -> ScanTruth:
    grid = frame.ra_map.grid
    stamps = frame.ra_map.stamps_at(grid.azimuth_at(np.arange(grid.azimuth_bins))) - frame.ra_map.stamp_ns
    truth = frame.truth or ()
    moving = frame.ra_map.ego_compensated
    return ScanTruth(walls, mirror, frame.labels, truth, frame.noise_power_mw, stamps, moving, mask)


def load_channels(path: Path) -> np.ndarray:
    """Return the channels of the scans of a file, int8 [scans, channels, x, y], as they lie on disk."""
    return np.load(_channels_path(path), mmap_mode="r")


def load_objects(path: Path) -> list[EvidenceObjects]:
    """Return the objects of the scans of a file."""
    return stored_tables(EvidenceObjects, "objects", load_arrays(path))


def load_candidates(path: Path) -> list[CandidateSamples]:
    """Return the candidates of the scans of a file."""
    return stored_tables(CandidateSamples, "candidates", load_arrays(path))


def load_truths(path: Path) -> list[ScanTruth]:
    """Return what the scoring of the scans of a file needs; raises `ValueError` naming it."""
    arrays = load_arrays(path)
    rows: list[Any] = [
        stored_tables(WallArrays, "walls", arrays),
        arrays["mirror"].astype(np.int16),
        stored_tables(FrameLabels, "labels", arrays),
        [msgspec.json.decode(text, type=tuple[TruthObject, ...]) for text in arrays["truth"].tolist()],
        arrays["noise_power_mw"].tolist(),
        arrays["azimuth_stamp_ns"],
        arrays["ego_compensated"].tolist(),
        arrays["visibility"],
    ]
    return [ScanTruth(*row) for row in zip(*rows, strict=True)]
