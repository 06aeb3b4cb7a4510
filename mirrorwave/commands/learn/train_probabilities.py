"""`mirrorwave train probabilities`: how likely what an object network answers is an object."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.commands.learn.train_objects import VALIDATION_SAMPLES, Maker, object_samples
from mirrorwave.console import AsJson, print_json, print_line, progress_bar


def probabilities(
    network: Annotated[
        Path, typer.Argument(metavar="FILE", help="Exported object network (ONNX), whose card gets the new tables.")
    ],
    validation: Annotated[
        list[Path], typer.Option(metavar="DIR", help="Scans with their true objects, none that it was trained on.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="FOLDER", help="Samples of the scans; a command that was stopped goes on in it.")
    ],
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Detector (ONNX); default: the committed one.")
    ] = None,
    flip_test: Annotated[
        bool, typer.Option("--flip-test", help="Both networks look at a scan and at its mirror image.")
    ] = False,
    false_cost: Annotated[
        float, typer.Option(min=0.0, help="Missed objects that a false report costs, for the threshold.")
    ] = 1.0,
    workers: Annotated[int, typer.Option(min=1, help="Files of samples made at a time.")] = 1,
    json: AsJson = False,
) -> None:
    """Fit the tables from an object network's answers to probabilities, and its threshold, to validation scans."""
    import msgspec

    from models.perception.detection.onnx_model import DEFAULT_MODEL, load_card
    from models.perception.objects.predictor import ObjectPredictor
    from models.training.data.frames import DataSet
    from models.training.export.onnx import write_card
    from models.training.object_probabilities import with_probabilities

    detector, judges = model or DEFAULT_MODEL, list(map(DataSet, validation))
    predictor = ObjectPredictor(network, flip_test=flip_test)
    maker = Maker(detector, predictor.card.encoding, flip_test)
    files = object_samples(judges, maker, out / VALIDATION_SAMPLES, None, workers)
    with progress_bar("answers"):
        card = with_probabilities(predictor.card, predictor, files, false_cost)
    command = f"mirrorwave train probabilities {network}{''.join(f' --validation {path}' for path in validation)}"
    command += f" --out {out} --model {detector.name}{' --flip-test' if flip_test else ''} --false-cost {false_cost:g}"
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
