"""What is asked of every figure: read off matplotlib's objects as they were saved, not off pixels.

Folders whose `conftest.py` takes the two fixtures in look at every figure that their tests save.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg, RendererAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.legend import Legend
from matplotlib.text import Text

from mirrorwave.plots.style import PAGE_INCH

#: Smallest letters that are read without a magnifying glass, once a figure is shrunk to a page's width.
LEAST_PT = 6.5


def legends_of(figure: Figure | SubFigure) -> list[Legend]:
    """All legends: of the figure, of its parts, of its axes."""
    parts = [one for part in figure.subfigs for one in legends_of(part)]
    return [*figure.legends, *(legend for axes in figure.axes if (legend := axes.get_legend())), *parts]


def panels_of(figure: Figure) -> list[Axes]:
    """Axes with data; one that is switched off holds signs alone."""
    return [axes for axes in figure.axes if axes.axison]


def assert_legends_off_data(figure: Figure) -> None:
    """Every legend lies within the figure and clear of every panel, to half a pixel."""
    legends = legends_of(figure)
    # a figure that has none need not be laid out
    renderer = _renderer(figure) if legends else None
    for legend in legends:
        box = legend.get_window_extent(renderer)
        said = [text.get_text() for text in legend.get_texts()]
        assert figure.bbox.x0 - 0.5 <= box.x0, said
        assert figure.bbox.y0 - 0.5 <= box.y0, said
        assert box.x1 <= figure.bbox.x1 + 0.5, said
        assert box.y1 <= figure.bbox.y1 + 0.5, said
        for axes in panels_of(figure):
            panel = axes.get_window_extent(renderer)
            apart_x = box.x1 <= panel.x0 + 0.5 or panel.x1 - 0.5 <= box.x0
            apart_y = box.y1 <= panel.y0 + 0.5 or panel.y1 - 0.5 <= box.y0
            assert apart_x or apart_y, (axes.get_title(loc="left") or axes.get_title(), said)


def _renderer(figure: Figure) -> RendererAgg:
    """What measures the figure's parts, all of them in their places; no pixel is drawn."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw_without_rendering()
    return renderer


def texts_of(figure: Figure) -> Iterator[Text]:
    """Every text that is shown."""
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip():
            yield text


def assert_readable_at_page_width(figure: Figure) -> None:
    """No text is smaller than `LEAST_PT` once the figure is shrunk to a page's width."""
    _renderer(figure)
    shrunk = min(1.0, PAGE_INCH / figure.get_figwidth())
    small = {text.get_text(): text.get_fontsize() * shrunk for text in texts_of(figure)}
    assert {text: round(size, 2) for text, size in small.items() if size < LEAST_PT} == {}


SAVED: list[Figure] = []


@pytest.fixture(scope="session", autouse=True)
def recorded() -> Iterator[None]:
    """Figures are noted as they are saved, whoever saves them."""
    save = Figure.savefig

    def noted(self: Figure, *arguments: Any, **options: Any) -> None:
        if not any(one is self for one in SAVED):
            SAVED.append(self)
        save(self, *arguments, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", noted)
        yield


@pytest.fixture(autouse=True)
def saved_figures() -> Iterator[list[Figure]]:
    """The figures that this test saved, oldest first; looked at when it ends."""
    # what tests of other folders saved in this process is not this test's
    SAVED.clear()
    yield SAVED
    figures = SAVED.copy()
    SAVED.clear()
    for figure in figures:
        assert_legends_off_data(figure)
