"""Common parts of all figures: the canvas, one colour for each meaning, legends beside the data, equal bytes.

Colours are from the Okabe-Ito set, which colour-blind readers tell apart.
"""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.transforms import ScaledTranslation

BLUE, SKY, GREEN, ORANGE = "#0072B2", "#56B4E9", "#009E73", "#E69F00"
VERMILION, PURPLE, GREY, BLACK = "#D55E00", "#8A1C66", "#555555", "#222222"
#: The meanings of a scene, the same in every picture of one.
SEEN_DIRECTLY, MIRROR_IMAGE, RECOVERED, TRUTH, TRACKED, WALL = BLUE, ORANGE, VERMILION, GREEN, PURPLE, BLACK
#: Areas in the tint of their meaning, light enough to draw upon.
DIRECT_AREA, MIRROR_AREA = "#E3F1FA", "#FBE9C6"
#: Width of a page's text in inches. A wider figure is shrunk to it, and its letters with it.
PAGE_INCH = 8.6
#: From an axes' edge to the legend below it in points: past the numbers and the label of the axis.
LEGEND_BELOW_PT = 34.0


def new_figure(width_inch: float, height_inch: float, **options: Any) -> Figure:
    """Return an empty figure with a canvas and the constrained layout."""
    figure = Figure(figsize=(width_inch, height_inch), layout="constrained", **options)
    FigureCanvasAgg(figure)
    return figure


def legend_below(axes: Axes, columns: int = 1, **options: Any) -> Legend:
    """Add the legend of an axes below its horizontal label, off the data."""
    assert axes.figure is not None
    shift = ScaledTranslation(0.0, -LEGEND_BELOW_PT / 72.0, axes.figure.dpi_scale_trans)
    placement = {"loc": "upper center", "bbox_to_anchor": (0.5, 0.0), "bbox_transform": axes.transAxes + shift}
    return axes.legend(
        **{**placement, "borderaxespad": 0.0, "ncols": columns, "frameon": False, "fontsize": 9, **options}
    )


def legend_beside(axes: Axes, **options: Any) -> Legend:
    """Add the legend of an axes to the right of it, off the data."""
    placement = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0), "borderaxespad": 0.0}
    return axes.legend(**{**placement, "frameon": False, "fontsize": 9, **options})


def legend_of_figure(figure: Figure, handles: Iterable[Artist], columns: int, **options: Any) -> Legend:
    """Add one legend for all panels at the figure's lower edge; of equal labels the first is taken."""
    once = {str(handle.get_label()): handle for handle in reversed(list(handles))}
    shown = [handle for _, handle in reversed(once.items())]
    placement = {"loc": "outside lower center", "ncols": columns, "frameon": False, "fontsize": 9}
    return figure.legend(handles=shown, **{**placement, **options})


def handles_of(*panels: Axes) -> list[Artist]:
    """Return the labelled artists of panels, in order."""
    return [handle for axes in panels for handle in axes.get_legend_handles_labels()[0]]


def save(figure: Figure, path: Path, dpi: int = 110) -> None:
    """Write a figure, the format by the suffix; equal figures give equal bytes."""
    # a PNG holds the version of matplotlib unless told not to
    figure.savefig(path, dpi=dpi, metadata={"Software": None} if path.suffix == ".png" else None)


def png(figure: Figure) -> bytes:
    """Return a figure as PNG, of a size for a notebook."""
    content = BytesIO()
    figure.savefig(content, format="png", dpi=80, metadata={"Software": None})
    return content.getvalue()
