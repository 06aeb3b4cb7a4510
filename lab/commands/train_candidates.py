"""`mirrorwave train candidates`: a second look at what an evidence network proposes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lab.commands.train_objects import ChosenBy, Detector, RunFolder, TrainedOn
from mirrorwave.console import AsJson, print_json, print_line, progress_bar

if TYPE_CHECKING:
    from lab.training.evidence.grid_training import GridEpoch

#: Candidates of a batch, largest learning rate and weight decay.
BATCH, RATE, DECAY = 256, 1e-3, 0.3


def candidates(
    network: Annotated[
        Path, typer.Argument(metavar="FILE", help="Exported evidence network (ONNX), whose card names the new network.")
    ],
    data: TrainedOn,
    validation: ChosenBy,
    out: RunFolder,
    model: Detector = None,
    epochs: Annotated[int, typer.Option(min=1)] = 4,
    seed: Annotated[int, typer.Option(min=0, help="First weights and order of the samples.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of torch.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="Files of samples made at a time.")] = 1,
    json: AsJson = False,
) -> None:
    """Train the network that looks at each candidate of an evidence network again, and write it beside that network.

    It serves with and without `--flip-test`. The probabilities of its answers are then to be fitted anew (`train
    probabilities`).
    """
    import msgspec

    from lab.training.evidence.grid_training import GridSchedule
    from lab.training.evidence.runs import CandidateRun
    from models.perception.find.onnx_model import DEFAULT_MODEL

    run = CandidateRun(
        network=network,
        data=data,
        validation=validation,
        folder=out,
        detector=model or DEFAULT_MODEL,
        workers=workers,
    )
    schedule = GridSchedule(
        epochs=epochs, batch_size=BATCH, learning_rate=RATE, weight_decay=DECAY, seed=seed, threads=threads,
        mixed_precision=False,
    )  # fmt: skip
    with progress_bar("epochs", epochs) as progress:

        def show(epoch: GridEpoch) -> None:
            scores = ", ".join(f"{name} {value:.3f}" for name, value in epoch.scores.items())
            progress.print(f"epoch {epoch.epoch}: loss {epoch.train_loss:.4f}, {epoch.loss:.4f} a scan, {scores}")
            progress()

        card = run.train(schedule, show)
    if json:
        print_json(msgspec.to_builtins(card))
        return
    scores = card.scores
    print_line(
        f"{run.file}: {scores['recall_single_25_db']:.1%} of those that one mirror shows at 25 dB, "
        f"{scores['false_per_scan']:.2f} false a scan; next: mirrorwave train probabilities {network}"
    )
