"""Field and evidence networks trained at size, on a machine with a GPU and many cores or on a patient one without.

Samples are made of the data sets as far as they are there, the field network is trained on them and exported, then the
evidence network on what both see. Each stage ends after its minutes; what is there already is kept.
Usage: python -m benchmarks.accuracy.evidence_at_size --places DIR --validation DIR --work DIR --out DIR
    [--drives DIR] [--detector FILE] [--stage fields|evidence] [--workers N] [--field-minutes M] [--evidence-minutes M]
"""

from __future__ import annotations

import argparse
import math
import shutil
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from models.perception.detection.encoding import Encoding
from models.perception.detection.onnx_model import DEFAULT_MODEL
from models.perception.evidence.scan_evidence import EvidenceEncoding
from models.training.data.evidence_store import EvidenceTask, FieldTask, make_files
from models.training.evidence.grid_training import GridEpoch, GridSchedule, GridTraining
from models.training.evidence.train_evidence import EvidenceTraining
from models.training.evidence.train_fields import FieldTraining
from models.training.export.evidence import export_evidence, export_fields
from models.training.files import file_sha256
from models.training.run_folder import CURVES
from msgs.values.radar import RangeAzimuthGrid

CHANNELS = ("level", "shadow", "contrast", "range", "azimuth", "level_real", "level_imaginary")
ENCODING, EVIDENCE, GRID = Encoding(channels=CHANNELS), EvidenceEncoding(), RangeAzimuthGrid()
FIELDS_FILE, EVIDENCE_FILE = "field_unet.onnx", "evidence_unet.onnx"


def main(argv: Sequence[str] | None = None) -> None:
    options = _options(argv)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.stage in ("fields", "all"):
        _fields(options)
    if options.stage in ("evidence", "all"):
        _evidence(options)


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=Path, action="append", required=True)
    parser.add_argument("--drives", type=Path, action="append", default=[])
    parser.add_argument("--validation", type=Path, action="append", required=True)
    parser.add_argument("--detector", type=Path, default=DEFAULT_MODEL)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--stage", choices=("fields", "evidence", "all"), default="all")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--field-start", type=Path, help="a detector (compact_unet.onnx) whose layers it begins with")
    parser.add_argument("--field-minutes", type=float, default=None)
    parser.add_argument("--evidence-minutes", type=float, default=None)
    parser.add_argument("--field-epochs", type=int, default=30)
    parser.add_argument("--evidence-epochs", type=int, default=12)
    parser.add_argument("--field-batch", type=int, default=32)
    parser.add_argument("--evidence-batch", type=int, default=32)
    parser.add_argument("--sample-minutes", type=float, help="for training samples of each network")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--validated-from", type=float, default=0.0)
    return parser.parse_args(argv)


def _fields(options: argparse.Namespace) -> None:
    judges = _samples(options, FieldTask(ENCODING), "fields", options.validation, None)
    train = _samples(options, FieldTask(ENCODING), "fields", [*options.drives, *options.places], 0)
    schedule = _schedule(options, "field", learning_rate=2e-3, weight_decay=1e-3)
    run = options.work / "fields"
    training = FieldTraining(train, judges, CHANNELS, GRID, schedule, run)
    if options.field_start is not None:
        training.start_from(options.field_start)
    best = _run("fields", training)
    said = _said(options, training, best)
    card = export_fields(run, ENCODING, GRID, options.out / FIELDS_FILE, **said)
    _kept(run, options.out / "fields-curves.json")
    print(f"fields: epoch {best.epoch} of {training.scans} scans, {card.scores}", flush=True)


def _evidence(options: argparse.Namespace) -> None:
    fields = options.out / FIELDS_FILE
    task = EvidenceTask(EVIDENCE, options.detector, fields)
    judges = _samples(options, task, "evidence", options.validation, None)
    train = _samples(options, task, "evidence", [*options.drives, *options.places], 0)
    schedule = _schedule(options, "evidence", learning_rate=3e-3, weight_decay=1e-2)
    run = options.work / "evidence"
    training = EvidenceTraining(train, judges, EVIDENCE, GRID, schedule, run)
    best = _run("evidence", training)
    said = _said(options, training, best)
    said["data"] |= {
        "fields": FIELDS_FILE,
        "detector": options.detector.name,
        "detector_sha256": file_sha256(options.detector),
        "fields_sha256": file_sha256(fields),
    }
    said["threshold"] = best.scores["threshold"]
    card = export_evidence(run, EVIDENCE, options.out / EVIDENCE_FILE, **said)
    _kept(run, options.out / "evidence-curves.json")
    print(f"evidence: epoch {best.epoch} of {training.scans} scans, {card.scores}", flush=True)


def _schedule(options: argparse.Namespace, network: str, learning_rate: float, weight_decay: float) -> GridSchedule:
    """Return the schedule of a network by its options; the rate is that of batches of 8."""
    epochs, batch_size, minutes = (getattr(options, f"{network}_{name}") for name in ("epochs", "batch", "minutes"))
    return GridSchedule(
        epochs=epochs,
        batch_size=batch_size,
        learning_rate=learning_rate * (batch_size / 8) ** 0.5,
        weight_decay=weight_decay,
        minutes=minutes,
        threads=options.threads,
        validated_from=options.validated_from,
    )


def _samples(
    options: argparse.Namespace,
    task: FieldTask | EvidenceTask,
    name: str,
    directories: Sequence[Path],
    seed: int | None,
) -> list[Path]:
    started, files = time.monotonic(), []
    for path in make_files(directories, task, options.work / f"{name}-samples", seed, options.workers):
        files.append(path)
        if seed is not None and time.monotonic() - started > 60.0 * (options.sample_minutes or math.inf):
            break
    files.sort()
    print(f"{name}: {len(files)} files of samples after {time.monotonic() - started:.0f} s", flush=True)
    return files


def _run(name: str, training: GridTraining) -> GridEpoch:
    def show(epoch: GridEpoch) -> None:
        scores = ", ".join(f"{key} {value:.3f}" for key, value in epoch.scores.items())
        print(
            f"{name}: epoch {epoch.epoch} after {epoch.seconds:.0f} s: loss {epoch.train_loss:.3f}, "
            f"validation {epoch.loss:.3f}, {scores}",
            flush=True,
        )

    return training.run(show)


def _said(options: argparse.Namespace, training: GridTraining, best: GridEpoch) -> dict[str, Any]:
    """Return what a card says of a run."""
    schedule = {name: getattr(training.schedule, name) for name in training.schedule.__dataclass_fields__}
    data = [path.name for path in (*options.places, *options.drives)]
    return {
        "scores": best.scores,
        "data": {"train": " ".join(data), "validation": " ".join(path.name for path in options.validation)},
        "training": {"scans": training.scans, "seconds": round(best.seconds), "schedule": schedule},
    }


def _kept(run: Path, path: Path) -> None:
    shutil.copyfile(run / CURVES, path)


if __name__ == "__main__":
    main()
