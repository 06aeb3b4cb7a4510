"""`mirrorwave train`: networks from simulated data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.console import print_line

app = typer.Typer(no_args_is_help=True, help="Train the networks on a simulated data set.")


@app.command()
def dense(
    data: Annotated[Path, typer.Option(metavar="DIR", help="Data set of `mirrorwave sim dataset`.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="Run folder; a run that was stopped goes on in it.")],
    epochs: Annotated[int, typer.Option(min=1)] = 20,
    seed: Annotated[int, typer.Option(help="Split, augmentation and first weights.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of torch.")] = 1,
) -> None:
    """Train the network that tells direct from mirrored returns."""
    from rich.progress import Progress

    from models.training.datasets import DataConfig, load_training_data
    from models.training.train_dense import DenseTraining, EpochReport, TrainDenseConfig

    config = TrainDenseConfig(epochs=epochs, seed=seed, threads=threads)
    training = DenseTraining(config, load_training_data(data, DataConfig(seed=seed)), out)
    with Progress() as progress:
        task = progress.add_task("epochs", total=epochs, completed=len(training.reports))

        def show(report: EpochReport) -> None:
            progress.console.print(
                f"epoch {report.epoch}: loss {report.train_loss:.3f}, validation {report.validation_loss:.3f}, "
                f"Macro-F1 {report.macro_f1:.3f} (LOS {report.los_f1:.3f}, mirrored {report.mirrored_f1:.3f})"
            )
            progress.advance(task)

        best = training.run(show)
    print_line(f"{out}: best Macro-F1 {best.macro_f1:.3f} in epoch {best.epoch}")
