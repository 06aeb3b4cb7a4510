"""The curves of a training run as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mirrorwave.plots.style import legend_below, new_figure, save

if TYPE_CHECKING:
    from lab.training.train_dense import EpochReport
    from lab.training.train_residual import ResidualEpoch


def draw_curves(reports: Sequence[EpochReport], path: Path) -> None:
    """Losses and validation scores over the epochs, as a PNG."""
    epochs = [report.epoch + 1 for report in reports]
    figure = new_figure(9.0, 4.2)
    losses, scores = figure.subplots(1, 2)
    losses.plot(epochs, [report.train_loss for report in reports], label="training")
    losses.plot(epochs, [report.validation_loss for report in reports], label="validation")
    losses.set(xlabel="epoch", ylabel="loss", yscale="log")
    scores.plot(epochs, [report.macro_f1 for report in reports], color="black", label="Macro-F1")
    scores.plot(epochs, [report.los_f1 for report in reports], label="direct")
    scores.plot(epochs, [report.mirrored_f1 for report in reports], label="mirrored")
    best = max(reports, key=lambda report: report.best_macro_f1)
    scores.axvline(best.epoch + 1, color="grey", linestyle=":", label="chosen")
    scores.set(xlabel="epoch", ylabel="validation F1", ylim=(0.0, 1.0))
    for axes in (losses, scores):
        legend_below(axes, columns=4)
        axes.grid(alpha=0.3)
    save(figure, path)


def draw_residual_curves(reports: Sequence[ResidualEpoch], path: Path) -> None:
    """Loss, recovered error and recovered F1 over the epochs, beside the mirror law alone, as a PNG."""
    epochs = [report.epoch + 1 for report in reports]
    best = min(reports, key=lambda report: report.recovered_l1_m)
    figure = new_figure(9.0, 4.2)
    errors, scores = figure.subplots(1, 2)
    errors.plot(epochs, [report.train_loss for report in reports], label="training")
    errors.plot(epochs, [report.recovered_l1_m for report in reports], color="black", label="validation")
    errors.axhline(best.recovered_l1_without_m, color="grey", label="without residual")
    errors.set(xlabel="epoch", ylabel="l1 [m]")
    scores.plot(epochs, [report.recovered_f1 for report in reports], color="black", label="validation")
    scores.axhline(best.recovered_f1_without, color="grey", label="without residual")
    scores.set(xlabel="epoch", ylabel="recovered F1 at 1 m")
    for axes in (errors, scores):
        axes.axvline(best.epoch + 1, color="grey", linestyle=":", label="chosen")
        legend_below(axes, columns=2)
        axes.grid(alpha=0.3)
    save(figure, path)
