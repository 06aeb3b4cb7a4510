"""`mirrorwave train objects`: the networks that see walls and judge what every place behind them may hold."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.console import AsJson, print_json, print_line, progress_bar

if TYPE_CHECKING:
    from lab.training.evidence.grid_training import GridEpoch, GridSchedule

#: Learning rates of batches of 8 of fresh networks and of trained ones, and weight decay.
FIELD_RATES, FIELD_DECAY, EVIDENCE_RATES, EVIDENCE_DECAY = (2e-3, 1.5e-3), 1e-3, (3e-3, 1e-3), 1e-2

TrainedOn = Annotated[
    list[Path], typer.Option(metavar="DIR", help="Scans with their true objects (sim dataset --truth, or drives).")
]
ChosenBy = Annotated[list[Path], typer.Option(metavar="DIR", help="Other such scans, that choose the epoch.")]
RunFolder = Annotated[Path, typer.Option(metavar="RUN", help="Run folder; a run that was stopped goes on in it.")]
Detector = Annotated[Path | None, typer.Option(metavar="FILE", help="Detector (ONNX); default: the committed one.")]


def objects(
    data: TrainedOn,
    validation: ChosenBy,
    out: RunFolder,
    model: Detector = None,
    fields: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Field network (ONNX), in place of training one.")
    ] = None,
    init: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Evidence network (ONNX, full precision) to go on from, its field network too."
        ),
    ] = None,
    epochs: Annotated[int, typer.Option(min=1, help="Of each network.")] = 8,
    minutes: Annotated[
        float | None, typer.Option(min=0.1, help="Most minutes for samples and for epochs, of each network.")
    ] = None,
    batch_size: Annotated[int, typer.Option(min=1)] = 8,
    seed: Annotated[int, typer.Option(min=0, help="First weights and order of the samples.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of torch.")] = 1,
    full_precision: Annotated[
        bool, typer.Option("--full-precision", help="Faster where the processor does not multiply bfloat16 itself.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Files of samples made at a time.")] = 1,
    json: AsJson = False,
) -> None:
    """Train the field network, which sees walls, and the evidence network, which judges what they may hide."""
    import math

    import msgspec

    from lab.training.evidence.grid_training import GridSchedule
    from lab.training.evidence.runs import EVIDENCE_FILE, EvidenceRun
    from models.perception.find.onnx_model import DEFAULT_MODEL

    detector = model or DEFAULT_MODEL
    run = EvidenceRun(
        data=data,
        validation=validation,
        folder=out,
        detector=detector,
        field_start=DEFAULT_MODEL,
        init=init,
        workers=workers,
        sample_minutes=minutes,
    )

    def schedule(rates: tuple[float, float], weight_decay: float) -> GridSchedule:
        return GridSchedule(
            epochs=epochs,
            batch_size=batch_size,
            learning_rate=rates[init is not None] * math.sqrt(batch_size / 8),
            weight_decay=weight_decay,
            minutes=minutes,
            seed=seed,
            threads=threads,
            mixed_precision=not full_precision,
        )

    with progress_bar("epochs", epochs * (2 if fields is None else 1)) as progress:

        def show(network: str, epoch: GridEpoch) -> None:
            scores = ", ".join(f"{name} {value:.3f}" for name, value in epoch.scores.items())
            progress.print(f"{network}: epoch {epoch.epoch}: loss {epoch.train_loss:.3f}, {scores}")
            progress()

        if fields is None:
            run.train_fields(schedule(FIELD_RATES, FIELD_DECAY), show)
        else:
            run.take_fields(fields)
        card = run.train_evidence(schedule(EVIDENCE_RATES, EVIDENCE_DECAY), show)
    if json:
        print_json(msgspec.to_builtins(card))
        return
    print_line(
        f"{out / EVIDENCE_FILE}: {card.scores['recall_single_25_db']:.1%} of those that one mirror shows at 25 dB, "
        f"{card.scores['false_per_scan']:.2f} false a scan at {card.threshold}"
    )
