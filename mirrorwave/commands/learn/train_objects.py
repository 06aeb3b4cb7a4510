"""`mirrorwave train objects`: the network that judges what each cell of a map would be if a wall had mirrored it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.console import print_json, print_line

if TYPE_CHECKING:
    from rich.progress import Progress

    from models.training.data.frames import DataSet
    from models.training.data.object_samples import SampleMaker
    from models.training.train_objects import ObjectEpoch, ObjectTraining

#: In the run folder: curves as a picture, samples of training and validation.
CURVES_PICTURE, TRAIN_SAMPLES, VALIDATION_SAMPLES = "curves.png", "samples-train", "samples-validation"


def objects(
    data: Annotated[Path, typer.Option(metavar="DIR", help="Scans with their true objects (sim dataset --scans).")],
    validation: Annotated[Path, typer.Option(metavar="DIR", help="Other such scans, that choose the epoch.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="Run folder; a run that was stopped goes on in it.")],
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Detector (ONNX); default: the committed one.")
    ] = None,
    epochs: Annotated[int, typer.Option(min=1)] = 12,
    batch_size: Annotated[int, typer.Option(min=1)] = 8,
    learning_rate: Annotated[float, typer.Option()] = 3e-3,
    seed: Annotated[int, typer.Option(min=0, help="First weights, order and augmentation of the samples.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of torch.")] = 1,
    json: Annotated[bool, typer.Option("--json", help="Print the best epoch as JSON.")] = False,
) -> None:
    """Train the network that judges what each cell of a map would be if a wall had mirrored it."""
    import msgspec
    from rich.console import Console
    from rich.progress import Progress

    from mirrorwave.plots.training_curves import draw_object_curves
    from models.perception.detection.detectors import NetworkDetector
    from models.perception.detection.onnx_model import DEFAULT_MODEL, load_card
    from models.perception.objects.encoding import ObjectEncoding
    from models.training.data.frames import DataSet
    from models.training.data.object_samples import SampleMaker
    from models.training.data.object_store import refuse_shared_places
    from models.training.ranks import joined_ranks
    from models.training.run_folder import adopt_config
    from models.training.schedules import ScheduleConfig
    from models.training.train_objects import ObjectRunConfig, ObjectTraining, TrainObjectsConfig

    detector, scenes, validation_scenes = model or DEFAULT_MODEL, DataSet(data), DataSet(validation)
    schedule = ScheduleConfig(
        epochs=epochs, batch_size=batch_size, learning_rate=learning_rate, weight_decay=1e-2, clip_norm=5.0
    )
    config = ObjectRunConfig(
        training=TrainObjectsConfig(schedule=schedule, seed=seed, threads=threads),
        encoding=ObjectEncoding(grid=scenes.grid),
        data={"train": str(data), "validation": str(validation), "detector_sha256": load_card(detector).sha256},
    )
    refuse_shared_places(scenes, validation_scenes)
    adopt_config(out, config)
    maker = SampleMaker(config.encoding, NetworkDetector(scenes.setup, detector))
    with Progress(console=Console(stderr=True)) as progress, joined_ranks() as ranks:
        train = _samples(scenes, maker, out / TRAIN_SAMPLES, seed, progress)
        chosen_by = _samples(validation_scenes, maker, out / VALIDATION_SAMPLES, None, progress)
        training = ObjectTraining(config, train, chosen_by, out, ranks)
        best = _run(training, progress)
    draw_object_curves(training.reports, out / CURVES_PICTURE)
    if json:
        print_json(msgspec.to_builtins(best))
        return
    print_line(f"{out}: best in epoch {best.epoch}: {_summary_line(best)}")


def _samples(scenes: DataSet, maker: SampleMaker, folder: Path, seed: int | None, progress: Progress) -> list[Path]:
    """Samples of all scans of a data set, kept in the run folder."""
    from models.training.data.object_store import make_samples

    task = progress.add_task(f"samples of {scenes.directory.name}", total=len(scenes))
    return make_samples(scenes, range(len(scenes)), maker, folder, seed, partial(progress.advance, task))


def _run(training: ObjectTraining, progress: Progress) -> ObjectEpoch:
    """Train with a bar for all batches and a line an epoch."""
    steps, done = training.steps_per_epoch, len(training.reports)
    total = training.config.schedule.epochs * steps
    task = progress.add_task("batches", total=total, completed=done * steps)

    def show(report: ObjectEpoch) -> None:
        progress.console.print(
            f"epoch {report.epoch}: loss {report.train_loss:.3f}, validation {report.validation_loss:.3f}, "
            f"{_summary_line(report)}"
        )

    return training.run(show, partial(progress.advance, task))


def _summary_line(report: ObjectEpoch) -> str:
    return (
        f"{report.recall:.1%} found ({report.recall_single_25_db:.1%} of those that one mirror shows at 25 dB), "
        f"{report.false_per_scan:.2f} false a scan at {report.threshold}"
    )
