"""Figures of results: legends off the data (conftest looks at every one), letters for a page, signs for all lines."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from matplotlib.figure import Figure

from lab.tradeoff.row_figures import draw_front, draw_stages
from lab.tradeoff.row_report import Report
from lab.training.training_curves import draw_curves as draw_training
from mirrorwave.plots.style import legend_below, legend_beside, legend_of_figure, new_figure, save
from tests.figures import assert_legends_off_data, assert_readable_at_page_width, legends_of


def test_a_legend_over_the_data_or_out_of_the_figure_is_caught() -> None:
    for place in ({"loc": "upper right"}, {"loc": "upper left", "bbox_to_anchor": (1.4, 1.0)}):
        figure = new_figure(5.0, 4.0)
        axes = figure.subplots()
        axes.plot([0.0, 1.0], [0.0, 1.0], label="a line")
        axes.legend(**place).set_in_layout(False)
        with pytest.raises(AssertionError):
            assert_legends_off_data(figure)


def test_small_letters_on_a_wide_figure_are_caught() -> None:
    # the numbers at the axes have 10 points: 5 on the page of a figure twice as wide
    wide, right = new_figure(17.2, 4.0), new_figure(8.6, 4.0)
    for figure in (wide, right):
        figure.subplots()
    with pytest.raises(AssertionError):
        assert_readable_at_page_width(wide)
    assert_readable_at_page_width(right)


@pytest.mark.parametrize("add", [legend_below, legend_beside])
def test_legends_of_an_axes_stand_off_it(add: Any) -> None:
    figure = new_figure(8.0, 4.0)
    for axes in figure.subplots(1, 2):
        axes.plot([0.0, 1.0], [0.0, 1.0], label="a line with a name of some length")
        axes.set_xlabel("time [s]")
        add(axes)
    assert_legends_off_data(figure)


def test_one_legend_for_all_panels_names_each_label_once() -> None:
    figure = new_figure(8.0, 4.0)
    first, second = figure.subplots(1, 2)
    handles = [axes.plot([0.0, 1.0], label=label)[0] for axes in (first, second) for label in ("a", "b")]
    legend = legend_of_figure(figure, handles, columns=2)
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]
    assert legend.legend_handles[0].get_color() == handles[0].get_color()
    assert_legends_off_data(figure)


def test_equal_figures_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        figure = new_figure(4.0, 3.0)
        figure.subplots().plot([0.0, 1.0])
        save(figure, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def words(figure: Figure) -> list[str]:
    return [text.get_text() for legend in legends_of(figure) for text in legend.get_texts()]


@pytest.mark.slow
def test_front_and_stages_of_the_committed_run(tmp_path: Path, saved_figures: list[Figure]) -> None:
    report = msgspec.json.decode(Path("docs/results/tradeoff.json").read_bytes(), type=Report)
    draw_front(report, tmp_path / "front.png")
    draw_stages(report, tmp_path / "stages.png")
    front, stages = saved_figures
    assert {"profile", "changes forming alone", "changes several"} <= set(words(front))
    # the numbered settings of the front stand in the legend, not beside the axes
    assert sum(one.startswith("on the front: ") for one in words(front)) == sum(row.pareto for row in report.rows)
    assert words(stages) == ["transport", "forming", "detection", "geometry"]
    for figure in saved_figures:
        assert_readable_at_page_width(figure)


@pytest.mark.slow
def test_curves_of_a_training_run(tmp_path: Path, saved_figures: list[Figure]) -> None:
    reports = [
        SimpleNamespace(
            epoch=epoch, train_loss=1.0 / (epoch + 1), validation_loss=1.1, macro_f1=0.5, los_f1=0.6, mirrored_f1=0.4,
            best_macro_f1=0.5 + 0.01 * epoch,
        )
        for epoch in range(4)
    ]  # fmt: skip
    draw_training(reports, tmp_path / "curves.png")  # type: ignore[arg-type]
    assert words(saved_figures[-1]) == ["training", "validation", "Macro-F1", "direct", "mirrored", "chosen"]
    assert_readable_at_page_width(saved_figures[-1])
