"""`mirrorwave train probabilities`: how likely what an evidence network answers is an object."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.commands.train_objects import Detector
from mirrorwave.console import AsJson, print_json, print_line, progress_bar

if TYPE_CHECKING:
    from models.perception.see.evidence_predictor import EvidenceCard

#: In the folder: samples of the validation scans.
VALIDATION_SAMPLES = "samples-validation"


def probabilities(
    network: Annotated[
        Path, typer.Argument(metavar="FILE", help="Exported evidence network (ONNX), whose card gets the new tables.")
    ],
    validation: Annotated[
        list[Path], typer.Option(metavar="DIR", help="Scans with their true objects, none that it was trained on.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Samples of the scans; a command that was stopped goes on in it.")
    ],
    model: Detector = None,
    flip_test: Annotated[
        bool, typer.Option("--flip-test", help="Both networks look at a scan and at its mirror image.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Files of samples made at a time.")] = 1,
    json: AsJson = False,
) -> None:
    """Fit the tables from an evidence network's answers to probabilities, and its threshold, to validation scans."""
    import msgspec

    from lab.training.export.onnx import write_card
    from models.perception.find.onnx_model import DEFAULT_MODEL, load_card

    detector = model or DEFAULT_MODEL
    card = _fitted(network, validation, detector, out / VALIDATION_SAMPLES, flip_test, workers)
    command = f"mirrorwave train probabilities {network}{''.join(f' --validation {path}' for path in validation)}"
    command += f" --out {out} --model {detector.name}{' --flip-test' if flip_test else ''}"
    fitted = {"command": command, "detector_sha256": load_card(detector).sha256}
    card = msgspec.structs.replace(card, training={**card.training, "probabilities": fitted})
    write_card(card, network)
    if json:
        print_json(msgspec.to_builtins(card))
        return
    scores = card.scores
    print_line(
        f"{network}: least loss {scores['loss_per_scan']:.3f} a scan from {card.threshold:g} on: "
        f"{scores.get('recall', 0.0):.1%} found, {scores['false_per_scan']:.2f} false a scan"
    )


def _fitted(
    network: Path,
    validation: list[Path],
    detector: Path,
    samples: Path,
    flip_test: bool,
    workers: int,
) -> EvidenceCard:
    from lab.training.data.evidence_store import EvidenceTask, make_files
    from lab.training.evidence.scoring import with_probabilities
    from models.perception.see.evidence_predictor import EvidencePredictor

    predictor = EvidencePredictor(network, flip_test=flip_test)
    task = EvidenceTask(predictor.card.encoding, detector, predictor.fields_path, flip_test)
    with progress_bar("samples and answers"):
        files = sorted(make_files(validation, task, samples, None, workers))
        return with_probabilities(predictor.card, predictor, files)
