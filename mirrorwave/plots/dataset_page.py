"""The statistics of a data set as one page that needs nothing else, and a contact sheet of its maps.

Figures are SVG in the page's own text colour, so that it reads on light and dark ground. LOS is blue and a circle,
mNLOS orange and a diamond.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mirrorwave.plots.style import legend_below
from models.perception.form.coarray import AzimuthInterpolator
from msgs.values.perception import PathClass
from msgs.values.radar import PRESETS, RangeAzimuthGrid
from sim_player.dataset.statistics import Histogram, SceneRecord, Statistics, read_records

BLUE, ORANGE, GREEN, GREY = "#2F86C8", "#E08A00", "#1A9E77", "#8A8A8A"
COLOURS = {"LOS": BLUE, "mNLOS": ORANGE, "walls": GREEN}
#: Stands in the figures for the colour of the page's text, which matplotlib cannot know.
INK = "#010203"
#: Maps of the contact sheet, and their rows and columns.
MAPS, SHEET = 24, (4, 6)
#: What a map shows over the noise.
SPAN_DB = (0.0, 60.0)

_STYLE = """
:root { color-scheme: light dark; --ink: #22262b; --soft: #6b7280; --ground: #ffffff; --line: #d8dbe0; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e6ea; --soft: #9aa2ad; --ground: #16181c; --line: #353a42; }
}
body { margin: 2.5rem auto; max-width: 74rem; padding: 0 1.5rem; color: var(--ink); background: var(--ground);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; margin: 0; } h2 { font-size: 1.05rem; margin: 2.5rem 0 .75rem; }
p { margin: .4rem 0; } .soft { color: var(--soft); }
.facts { display: grid; grid-template-columns: repeat(4, 1fr); gap: 1rem 1.5rem; margin: 1.5rem 0; }
.facts div { border-top: 2px solid var(--line); padding-top: .4rem; }
.facts b { display: block; font-size: 1.35rem; font-weight: 600; font-variant-numeric: tabular-nums; }
.facts span { color: var(--soft); font-size: .85rem; }
@media (max-width: 40rem) { .facts { grid-template-columns: repeat(2, 1fr); } }
.panels { columns: 3 19rem; column-gap: 2rem; }
figure { margin: 0 0 1.75rem; break-inside: avoid; }
figcaption { font-weight: 600; font-size: .92rem; margin-bottom: .2rem; }
svg, img { width: 100%; height: auto; display: block; } svg { color: var(--ink); }
"""


def write_page(folder: Path, statistics: Statistics, out: Path) -> None:
    """Write the page and, beside it with the suffix .png, the contact sheet."""
    records = sampled_records(folder, statistics.scenes)
    write_contact_sheet(records, str(statistics.series.get("preset", "xband")), out.with_suffix(".png"))
    out.write_text(page(folder.name, statistics, out.with_suffix(".png").read_bytes()), encoding="utf-8")


def page(name: str, statistics: Statistics, sheet_png: bytes) -> str:
    """The whole page as text."""
    title = html.escape(f"Data set {name}")
    panels = "".join(
        f"<figure><figcaption>{html.escape(caption)}</figcaption>{figure}</figure>"
        for caption, figure in _panels(statistics)
    )
    picture = base64.b64encode(sheet_png).decode("ascii")
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head>\n<body>'
        f'<h1>{title}</h1><p class="soft">{html.escape(_series_line(statistics.series))}</p>\n{_facts(statistics)}\n'
        f'<div class="panels">{panels}</div>\n<h2>Maps</h2>'
        '<p class="soft">Range-azimuth maps in dB over the noise; circles: seen directly (LOS), '
        "diamonds: seen in a mirror (mNLOS).</p>"
        f'<img alt="Contact sheet of maps with labels" src="data:image/png;base64,{picture}"></body></html>\n'
    )


def sampled_records(folder: Path, scenes: int) -> list[SceneRecord]:
    """Up to 24 scenes, evenly over the data set."""
    wanted = set(np.unique(np.linspace(0, scenes - 1, min(MAPS, scenes)).astype(int)).tolist())
    return [record for record in read_records(folder) if record.index in wanted]


def write_contact_sheet(records: Sequence[SceneRecord], preset: str, out: Path) -> None:
    """PNG of up to 24 maps with their labels; equal records give equal bytes."""
    grid, form = RangeAzimuthGrid(), _former(preset)
    farthest_m = _reach_m(records)
    figure = Figure(figsize=(17.0, 14.4), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(*SHEET).ravel()
    image = None
    for axes, record in zip(panels, records, strict=False):
        image = _draw_map(axes, record, form(record), grid, farthest_m)
    for axes in panels[len(records) :]:
        axes.set_axis_off()
    for axes in panels[:: SHEET[1]]:
        axes.set_ylabel("range [m]", fontsize=9)
    for axes in panels[-SHEET[1] :]:
        axes.set_xlabel("azimuth [deg], left is positive", fontsize=9)
    if image is not None:
        figure.colorbar(image, ax=panels.tolist(), label="dB over noise", shrink=0.4, aspect=40, pad=0.01)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2, frameon=False)
    figure.savefig(out, dpi=100, metadata={"Software": None})


def _former(preset: str) -> Callable[[SceneRecord], np.ndarray]:
    """Return the function that makes a map of a record, power over noise [range, azimuth], as in the vehicle."""
    interpolator = AzimuthInterpolator(PRESETS[preset])
    gain = interpolator.noise_gain()

    def form(record: SceneRecord) -> np.ndarray:
        values, _ = interpolator.interpolate(record.profiles, record.noise_power_mw)
        return np.abs(values) ** 2 / (gain * record.noise_power_mw)

    return form


def _reach_m(records: Sequence[SceneRecord]) -> float:
    """Range that holds nearly all labels, in steps of 10 m."""
    ranges = np.concatenate([record.points["range_m"] for record in records])
    return float(np.clip(10.0 * np.ceil(0.1 * np.quantile(ranges, 0.98)), 20.0, 110.0)) if len(ranges) else 60.0


def _draw_map(axes: Axes, record: SceneRecord, power: np.ndarray, grid: RangeAzimuthGrid, farthest_m: float) -> Any:
    """One map with its labels."""
    level_db = 10.0 * np.log10(np.maximum(power, 1e-3))
    limit, top = grid.azimuth_limit_deg, grid.range_m[-1]
    image = axes.imshow(
        level_db,
        origin="lower",
        extent=(-limit, limit, 0.0, top),
        aspect="auto",
        cmap="gray",
        vmin=SPAN_DB[0],
        vmax=SPAN_DB[1],
        interpolation="nearest",
    )
    points = record.points
    for kind, mark, name in ((PathClass.LOS, "o", "LOS"), (PathClass.MIRRORED, "D", "mNLOS")):
        mine = points["path_class"] == kind
        axes.plot(
            np.degrees(points["azimuth_rad"][mine]),
            points["range_m"][mine],
            mark,
            markersize=4.2,
            markerfacecolor="none",
            markeredgecolor="#4DB2F0" if kind == PathClass.LOS else "#FFA01E",
            markeredgewidth=1.1,
            label=name,
        )
    # REP-103: azimuth counts to the left
    axes.set_xlim(limit, -limit)
    axes.set_ylim(0.0, farthest_m)
    axes.set_xticks([60, 30, 0, -30, -60])
    axes.tick_params(labelsize=7)
    axes.set_title(f"{record.index}  {str(record.facts['place']).replace('_', ' ')}", fontsize=9)
    return image


def _facts(statistics: Statistics) -> str:
    """The headline numbers."""
    objects = statistics.objects.values()
    rows = [
        (f"{statistics.scenes:,}", "scenes"),
        (f"{statistics.points['LOS']:,}", "LOS points"),
        (f"{statistics.points['mNLOS']:,}", "mNLOS points"),
        (f"{sum(counts.direct for counts in objects):,}", "objects seen directly"),
        (f"{sum(counts.hidden for counts in objects):,}", "objects seen in mirrors alone"),
        (f"{statistics.hidden_in_noise:,}", "more in mirrors, lost in noise"),
        (f"{100.0 * statistics.nothing_hidden_share:.1f} %", "scenes with nothing hidden"),
        (
            f"{statistics.paths[1]:,.0f}",
            f"paths a scene (median; {statistics.paths[0]:,.0f} to {statistics.paths[2]:,.0f})",
        ),
    ]
    cells = "".join(f"<div><b>{value}</b><span>{text}</span></div>" for value, text in rows)
    return f'<div class="facts">{cells}</div>'


def _panels(statistics: Statistics) -> list[tuple[str, str]]:
    """All figures with their captions."""
    panels = [
        ("Types of place, scenes", _bars(statistics.places)),
        ("Objects by class", _object_bars(statistics)),
        (
            "Hidden objects a scene that show in a mirror, scenes",
            _columns(statistics.hidden_per_scene, "hidden objects"),
        ),
        ("Objects a scene, scenes", _columns(statistics.objects_per_scene, "objects")),
        ("Walls as built", _bars(statistics.relays)),
        ("Materials of walls", _bars(statistics.materials)),
        ("Points by range", _histogram(statistics.range_m, "range [m]")),
        ("Points by SNR in their best beam", _histogram(statistics.snr_db, "SNR [dB]")),
        ("Points by mirrors on their way", _bars(statistics.orders)),
        ("Walls by roughness", _histogram(statistics.roughness_mm, "rms roughness [mm]", even=True)),
        (
            "Effects used, share of scenes",
            _bars({name: 100.0 * share for name, share in statistics.effects.items()}, " %"),
        ),
    ]
    # the first series does not know of which kinds its walls are
    return [panel for panel in panels if statistics.relays or panel[0] != "Walls as built"]


def _bars(counts: dict[str, Any], unit: str = "") -> str:
    """Horizontal bars with their numbers, the first on top."""

    def draw(axes: Axes) -> None:
        names = [name.replace("_", " ") for name in counts]
        bars = axes.barh(names, list(counts.values()), color=GREEN, height=0.7)
        axes.bar_label(bars, [f"{value:,.0f}{unit}" for value in counts.values()], padding=3, fontsize=9)
        axes.invert_yaxis()
        axes.margins(x=0.14)
        axes.set_xticks([])
        axes.tick_params(left=False)
        axes.spines[:].set_visible(False)

    return _svg(draw, 0.6 + 0.24 * max(len(counts), 4))


def _object_bars(statistics: Statistics) -> str:
    """Objects by class, split by how they are seen."""

    def draw(axes: Axes) -> None:
        names, start = list(statistics.objects), np.zeros(len(statistics.objects))
        parts = (("direct", BLUE, "direct"), ("mirrors alone", ORANGE, "hidden"), ("no points", GREY, "unseen"))
        for label, colour, field in parts:
            width = np.array([getattr(counts, field) for counts in statistics.objects.values()], float)
            axes.barh(names, width, left=start, color=colour, height=0.7, label=label)
            start += width
        axes.invert_yaxis()
        axes.tick_params(left=False)
        axes.spines[["top", "right", "left"]].set_visible(False)
        legend_below(axes, columns=3)

    return _svg(draw, 2.4)


def _columns(counts: dict[int, int], label: str) -> str:
    """Columns over whole numbers."""

    def draw(axes: Axes) -> None:
        bars = axes.bar([str(number) for number in counts], list(counts.values()), color=GREEN, width=0.7)
        axes.bar_label(bars, [f"{value:,}" for value in counts.values()], padding=2, fontsize=9)
        axes.set_xlabel(label)
        axes.margins(y=0.12)
        axes.set_yticks([])
        axes.spines[["top", "right", "left"]].set_visible(False)

    return _svg(draw, 2.2)


def _histogram(histogram: Histogram, label: str, even: bool = False) -> str:
    """Stacked columns between edges; `even` draws bins of unequal width alike."""

    def draw(axes: Axes) -> None:
        edges = np.arange(len(histogram.edges), dtype=float) if even else np.array(histogram.edges)
        start = np.zeros(len(edges) - 1)
        for name, counts in histogram.counts.items():
            width = np.diff(edges) * 0.92
            axes.bar(edges[:-1], counts, width, start, align="edge", color=COLOURS[name], label=name)
            start += counts
        if even:
            axes.set_xticks(edges, [f"{edge:g}" for edge in histogram.edges], fontsize=8)
        axes.set_xlabel(label)
        axes.spines[["top", "right"]].set_visible(False)
        if len(histogram.counts) > 1:
            legend_below(axes, columns=len(histogram.counts))

    return _svg(draw, 2.5)


def _svg(draw: Callable[[Axes], None], height_inch: float) -> str:
    """One figure as SVG in the page's text colour; equal data give equal text."""
    ink = dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK)
    style = {"svg.fonttype": "none", "svg.hashsalt": "mirrorwave", "font.size": 10, "font.family": "sans-serif", **ink}
    with rc_context(style):
        figure = Figure(figsize=(5.2, height_inch), layout="constrained")
        draw(figure.subplots())
        text = io.StringIO()
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    drawing = text.getvalue()
    return drawing[drawing.index("<svg") :].replace(INK, "currentColor")


def _series_line(series: dict[str, Any]) -> str:
    """Describe the data set, in words."""
    effects = series.get("effects", "?")
    used = ", ".join(effects) if isinstance(effects, list) else str(effects)
    budget = f" under {series['budget_db']:g} dB" if series.get("budget_db") is not None else ""
    facts = [f"{name} {series.get(name, '?')}" for name in ("seed", "places", "preset")]
    return f"{', '.join(facts)}; effects {used}{budget}; drawn by {series.get('generator', '?')}"
