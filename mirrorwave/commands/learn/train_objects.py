"""`mirrorwave train objects`: the network that judges what each cell of a map would be if a wall had mirrored it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from mirrorwave.console import print_json, print_line, progress_bar

if TYPE_CHECKING:
    from models.perception.objects.encoding import ObjectEncoding
    from models.training.data.frames import DataSet
    from models.training.data.object_samples import SampleMaker
    from models.training.train_objects import ObjectEpoch, ObjectRunConfig, ObjectTraining

#: In the run folder: network with its card, curves as a picture, samples of training and validation.
MODEL_FILE = "object_unet.onnx"
CURVES_PICTURE, TRAIN_SAMPLES, VALIDATION_SAMPLES = "curves.png", "samples-train", "samples-validation"


def objects(
    data: Annotated[
        list[Path], typer.Option(metavar="DIR", help="Scans with their true objects (sim dataset --truth, or drives).")
    ],
    validation: Annotated[list[Path], typer.Option(metavar="DIR", help="Other such scans, that choose the epoch.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="Run folder; a run that was stopped goes on in it.")],
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Detector (ONNX); default: the committed one.")
    ] = None,
    start: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Train on from this object network (ONNX), at a small rate."),
    ] = None,
    epochs: Annotated[int, typer.Option(min=1)] = 12,
    batch_size: Annotated[int, typer.Option(min=1)] = 8,
    learning_rate: Annotated[float, typer.Option()] = 3e-3,
    seed: Annotated[int, typer.Option(min=0, help="First weights, order and augmentation of the samples.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of torch.")] = 1,
    full_precision: Annotated[
        bool, typer.Option("--full-precision", help="Faster where the processor does not multiply bfloat16 itself.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Files of samples made at a time.")] = 1,
    json: Annotated[bool, typer.Option("--json", help="Print the card as JSON.")] = False,
) -> None:
    """Train the network that judges what each cell of a map would be if a wall had mirrored it."""
    import msgspec

    from mirrorwave.plots.training_curves import draw_object_curves
    from models.perception.detection.onnx_model import DEFAULT_MODEL, load_card
    from models.perception.objects.encoding import ObjectEncoding
    from models.perception.objects.predictor import load_object_card
    from models.perception.trained_radar import TrainedRadar
    from models.training.data.frames import DataSet
    from models.training.export.objects import export_objects_run
    from models.training.ranks import lone_device
    from models.training.run_folder import adopt_config
    from models.training.schedules import ScheduleConfig
    from models.training.train_objects import ObjectRunConfig, ObjectTraining, TrainObjectsConfig

    device = lone_device()
    detector, scenes, judges = model or DEFAULT_MODEL, list(map(DataSet, data)), list(map(DataSet, validation))
    schedule = ScheduleConfig(
        epochs=epochs, batch_size=batch_size, learning_rate=learning_rate, weight_decay=1e-2, clip_norm=5.0
    )
    config = ObjectRunConfig(
        training=TrainObjectsConfig(
            schedule=schedule,
            seed=seed,
            threads=threads,
            mixed_precision=not full_precision,
            start="" if start is None else str(start),
        ),
        encoding=ObjectEncoding(grid=scenes[0].grid, speeds=True),
        radar=TrainedRadar.of(scenes[0].setup),
        data={
            "train": " ".join(map(str, data)),
            "validation": " ".join(map(str, validation)),
            "detector": detector.name,
            "detector_sha256": load_card(detector).sha256,
            **({} if start is None else {"start_sha256": load_object_card(start).sha256}),
        },
    )
    _check_data(scenes, judges)
    _check_start(start, config)
    adopt_config(out, config)
    maker = Maker(detector, config.encoding)
    train = object_samples(scenes, maker, out / TRAIN_SAMPLES, seed, workers)
    chosen_by = object_samples(judges, maker, out / VALIDATION_SAMPLES, None, workers)
    training = ObjectTraining(config, train, chosen_by, out, device)
    best = _run(training)
    file = out / MODEL_FILE
    card = export_objects_run(out, chosen_by, file)
    draw_object_curves(training.reports, out / CURVES_PICTURE)
    if json:
        print_json(msgspec.to_builtins(card))
        return
    print_line(f"{file}: epoch {best.epoch}: {_summary_line(best)}")


def _check_data(scenes: Sequence[DataSet], judges: Sequence[DataSet]) -> None:
    """Raise `ValueError` where data sets are of different radars, or validation places are trained on."""
    from models.training.data.object_store import refuse_shared_places

    first = scenes[0]
    for data in (*scenes, *judges):
        if (data.grid, data.setup) != (first.grid, first.setup):
            raise ValueError(f"{data.directory}: radar and grid must be those of {first.directory}")
    for train, judge in product(scenes, judges):
        refuse_shared_places(train, judge)


def _check_start(start: Path | None, config: ObjectRunConfig) -> None:
    """Refuse a file that no training can go on from before samples are made, which takes long."""
    from models.networks.object_unet import ObjectUNet
    from models.training.exported_weights import load_exported

    if start is not None:
        load_exported(ObjectUNet(config.network), start)


class Maker(NamedTuple):
    """How samples are made, for any process."""

    detector: Path
    encoding: ObjectEncoding
    flip_test: bool = False


class _Job(NamedTuple):
    """Samples of some scans of a data set, to one file."""

    data: Path
    scans: range
    maker: Maker
    path: Path
    seed: int | None


def object_samples(scenes: Sequence[DataSet], maker: Maker, folder: Path, seed: int | None, workers: int) -> list[Path]:
    """Samples of all scans of the data sets, kept in a folder."""
    from models.training.data.object_store import sample_files
    from sim_player.dataset.executors import map_jobs

    jobs = [
        _Job(data.directory, scans, maker, path, seed)
        for number, data in enumerate(scenes)
        for path, scans in sample_files(len(data), folder / f"{number:02d}").items()
    ]
    with progress_bar(folder.name, sum(map(len, scenes))) as advance:
        for count in map_jobs(_make, jobs, workers=workers):
            advance(count)
    return [job.path for job in jobs]


def _make(job: _Job) -> int:
    """Make one file of samples; the number of its scans."""
    from models.training.data.object_store import make_file

    make_file(_data_set(job.data), job.scans, _sample_maker(job.data, job.maker), job.path, job.seed)
    return len(job.scans)


@cache
def _data_set(folder: Path) -> DataSet:
    """A data set, opened once a process."""
    from models.training.data.frames import DataSet

    return DataSet(folder)


@cache
def _sample_maker(folder: Path, maker: Maker) -> SampleMaker:
    """Parts of a vehicle for the radar of a data set, loaded once a process."""
    from models.perception.detection.detectors import NetworkDetector
    from models.training.data.object_samples import SampleMaker

    detector = NetworkDetector(_data_set(folder).setup, maker.detector, flip_test=maker.flip_test)
    return SampleMaker(maker.encoding, detector)


def _run(training: ObjectTraining) -> ObjectEpoch:
    """Train with a bar for all batches and a line an epoch."""
    steps, done = training.steps_per_epoch, len(training.reports)
    total = training.config.schedule.epochs * steps
    with progress_bar("batches", total, done * steps) as progress:

        def show(report: ObjectEpoch) -> None:
            progress.print(
                f"epoch {report.epoch}: loss {report.train_loss:.3f}, validation {report.validation_loss:.3f}, "
                f"{_summary_line(report)}"
            )

        return training.run(show, progress)


def _summary_line(report: ObjectEpoch) -> str:
    return (
        f"{report.recall:.1%} found ({report.recall_single_25_db:.1%} of those that one mirror shows at 25 dB), "
        f"{report.false_per_scan:.2f} false a scan at {report.threshold}"
    )
