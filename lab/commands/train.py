"""`mirrorwave train`: networks from data sets."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lab.commands.train_candidates import candidates
from lab.commands.train_objects import objects
from lab.commands.train_probabilities import probabilities
from lab.commands.train_residual import residual
from mirrorwave.console import print_json, print_line, progress_bar

if TYPE_CHECKING:
    from lab.training.train_dense import DenseTraining, EpochReport

app = typer.Typer(no_args_is_help=True, help="Train the networks on a data set.")
app.command()(residual)
app.command()(objects)
app.command()(candidates)
app.command()(probabilities)


@app.command()
def dense(
    data: Annotated[Path, typer.Option(metavar="DIR", help="Data set; its fixed splits train, choose and test.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="Run folder; a run that was stopped goes on in it.")],
    network: Annotated[
        str,
        typer.Option(
            metavar="NAME[:SIZE]", help="compact_unet, unet, swin_unet, ...; compact, fine (77 GHz), native, full."
        ),
    ] = "compact_unet:compact",
    inputs: Annotated[
        str | None, typer.Option("--input", metavar="NAME", help="complex, log, both, levels, levels+phase, ...")
    ] = None,
    schedule: Annotated[str, typer.Option(help="one_cycle; published (section 3.3); fine_tuning.")] = "one_cycle",
    epochs: Annotated[int | None, typer.Option(min=1, help="Default: the schedule's.")] = None,
    batch_size: Annotated[int | None, typer.Option(min=1, help="Default: the schedule's.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Default: the schedule's.")] = None,
    more: Annotated[list[Path] | None, typer.Option(metavar="DIR", help="A further data set, to train on.")] = None,
    limit: Annotated[int, typer.Option(min=0, help="At most this many training scenes; 0: all.")] = 0,
    init: Annotated[Path | None, typer.Option(metavar="FILE", help="Checkpoint or ONNX file to start from.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Augmentation and first weights.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of torch.")] = 1,
    json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Train a network that tells direct from mirrored returns, on this CPU or a GPU."""
    import msgspec

    from lab.training.data.frames import DataSet
    from lab.training.data.samples import DataConfig, load_training_data
    from lab.training.map_networks import FAMILIES, preset_network
    from lab.training.schedules import SCHEDULES
    from lab.training.train_dense import DenseTraining, TrainDenseConfig
    from lab.training.training_curves import draw_curves

    family, _, size = network.partition(":")
    choice, encoding = preset_network(family, size or "compact", inputs)
    if schedule not in SCHEDULES:
        raise ValueError(f"--schedule must be one of {', '.join(SCHEDULES)}, got {schedule!r}")
    objective = FAMILIES[family].objective
    if schedule == "fine_tuning":
        # the released class weights
        objective = replace(objective, class_weights=(1.5, 1.0))
    given: dict[str, Any] = {"epochs": epochs, "batch_size": batch_size, "learning_rate": learning_rate}
    config = TrainDenseConfig(
        network=choice,
        objective=objective,
        schedule=replace(SCHEDULES[schedule], **{name: value for name, value in given.items() if value is not None}),
        seed=seed,
        threads=threads,
        init=str(init or ""),
    )
    folders = tuple(str(folder) for folder in more or ())
    data_config = DataConfig(
        directory=str(data), more=folders, limit=limit, seed=seed, encoding=encoding, grid=DataSet(data).grid
    )
    training = DenseTraining(config, load_training_data(data_config), out)
    _run(training)
    summary = training.summary()
    draw_curves(training.reports, out / "curves.png")
    if json:
        print_json(msgspec.to_builtins(summary))
        return
    print_line(
        f"{out}: best Macro-F1 {summary.best.best_macro_f1:.3f} at {summary.best.best_threshold} in epoch "
        f"{summary.best.epoch}{', not converged' if summary.unconverged else ''}"
    )


def _run(training: DenseTraining) -> None:
    """Train with a bar for all batches and a line an epoch."""
    epochs, steps = training.config.schedule.epochs, training.steps_per_epoch
    with progress_bar("batches", epochs * steps, len(training.reports) * steps) as progress:

        def show(report: EpochReport) -> None:
            progress.print(
                f"epoch {report.epoch}: loss {report.train_loss:.3f}, validation {report.validation_loss:.3f}, "
                f"Macro-F1 {report.macro_f1:.3f} (LOS {report.los_f1:.3f}, mirrored {report.mirrored_f1:.3f}), "
                f"best {report.best_macro_f1:.3f} at {report.best_threshold}"
            )

        training.run(show, lambda done, of: progress())
