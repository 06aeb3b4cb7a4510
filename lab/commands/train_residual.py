"""`mirrorwave train residual`: the learned correction of folded places, Eq. (18)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mirrorwave.console import print_line, progress_bar

if TYPE_CHECKING:
    from lab.training.data.residual_samples import FoldedImages
    from lab.training.train_residual import ResidualEpoch, ResidualTraining

#: In the run folder: the network of a finished run with its card beside it, the curves, and the samples of a split.
MODEL_FILE, CURVES_PICTURE, SAMPLES = "residual.onnx", "curves.png", "samples-{}.npz"


def residual(
    data: Annotated[Path, typer.Option(metavar="DIR", help="Data set; its fixed splits are used.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="Run folder; a run that was stopped goes on in it.")],
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Detector (ONNX); default: the committed one.")
    ] = None,
    reach_m: Annotated[
        float, typer.Option(metavar="M", help="Learn from images folded this near their true place (published: all).")
    ] = 2.0,
    epochs: Annotated[int, typer.Option(min=1)] = 100,
    seed: Annotated[int, typer.Option(min=0, help="First weights and order of the samples.")] = 0,
    init: Annotated[Path | None, typer.Option(metavar="FILE", help="Checkpoint to start from.")] = None,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads of torch.")] = 1,
) -> None:
    """Train the network that corrects what the mirror law of the specification's walls leaves over."""
    from lab.training.data.frames import fixed_splits
    from lab.training.export.residual import export_residual_run
    from lab.training.run_folder import adopt_config
    from lab.training.train_residual import ResidualRunConfig, ResidualTraining, TrainResidualConfig
    from lab.training.training_curves import draw_residual_curves
    from models.perception.find.onnx_model import DEFAULT_MODEL, load_card

    detector = model or DEFAULT_MODEL
    config = ResidualRunConfig(
        training=TrainResidualConfig(epochs=epochs, seed=seed, reach_m=reach_m, threads=threads, init=str(init or "")),
        data={
            "directory": str(data),
            "test_sha256": fixed_splits(data).test_sha256,
            "detector_sha256": load_card(detector).sha256,
        },
    )
    adopt_config(out, config)
    folded = _folded(data, detector, out)
    training = ResidualTraining(config, folded["train"], folded["validation"], out)
    _run(training)
    draw_residual_curves(training.reports, out / CURVES_PICTURE)
    command = f"mirrorwave train residual --data {data} --out {out}"
    command += f" --model {detector} --reach-m {reach_m:g} --epochs {epochs} --seed {seed}"
    command += f" --init {init}" if init else ""
    scores = export_residual_run(out, folded["test"], out / MODEL_FILE, command).metrics
    print_line(
        f"{out / MODEL_FILE}: on test scenes recovered l1 {scores['l1_m']:.3f} m "
        f"(without {scores['l1_m_without']:.3f}), F1 {scores['f1']:.3f} (without {scores['f1_without']:.3f})"
    )


def _folded(data: Path, model: Path, out: Path) -> dict[str, FoldedImages]:
    """Folded images of each split, kept in the run folder."""
    from lab.training.data.frames import DataSet, fixed_splits
    from lab.training.data.residual_samples import fold_scenes, load_folded, save_folded
    from models.perception.find.detectors import NetworkDetector

    scenes, splits, folded = DataSet(data), fixed_splits(data), {}
    for split in ("train", "validation", "test"):
        path = out / SAMPLES.format(split)
        if not path.exists():
            indices = splits.of(split)
            # the published chain takes the heatmap's maxima
            detector = NetworkDetector(scenes.setup, model, refine=False)
            with progress_bar(f"{split} scenes", len(indices)) as on_scene:
                save_folded(path, fold_scenes(scenes, indices, detector, on_scene))
        folded[split] = load_folded(path)
    return folded


def _run(training: ResidualTraining) -> None:
    """Train with a bar and a line for each epoch."""
    with progress_bar("epochs", training.config.epochs, len(training.reports)) as progress:

        def show(report: ResidualEpoch) -> None:
            progress.print(
                f"epoch {report.epoch}: loss {report.train_loss:.3f}, recovered l1 {report.recovered_l1_m:.3f} m "
                f"(without {report.recovered_l1_without_m:.3f}), F1 {report.recovered_f1:.3f} "
                f"(without {report.recovered_f1_without:.3f})"
            )
            progress()

        training.run(show)
