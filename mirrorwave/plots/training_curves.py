"""The curves of a training run as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from models.training.train_dense import EpochReport


def draw_curves(reports: Sequence[EpochReport], path: Path) -> None:
    """Losses and validation scores over the epochs, as a PNG."""
    from mirrorwave.plots.style import legend_below, new_figure, save

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
