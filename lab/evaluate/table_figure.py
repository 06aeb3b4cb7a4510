"""Scenes of the specification's table side by side: one column a scene, five rows, three scenes a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lab.evaluate.labelled_beams import LabelledPlace
from lab.evaluate.method_figures import COLUMNS, draw_map, draw_peaks, scene_panels
from lab.evaluate.method_runs import answer_of
from lab.evaluate.specification_table import Row, TablePlan, formed_map, looks_at
from lab.tradeoff.row_runs import FrameResult, PlaceTruth
from mirrorwave.plots.bird_eye_view import draw_view, finish, limits_of
from mirrorwave.plots.scene import draw_scene
from mirrorwave.plots.style import handles_of, legend_of_figure, save
from mirrorwave.profiles import DEFAULT
from msgs.values.radar import RangeAzimuthGrid

PICTURES = 2
LIMIT_RAD = math.radians(RangeAzimuthGrid().azimuth_limit_deg)


def draw_table_scenes(plan: TablePlan, results: Sequence[FrameResult], out: Path) -> list[str]:
    """Write the pictures and return their names: scene, map, and what the last system of the specification that ran
    and ours make of it.
    """
    failed = {name for result in results for name in result.failed}
    rows = [row for row in plan.rows if row.name not in failed]
    rows = [*[row for row in rows if row.label != DEFAULT][-1:], *[row for row in rows if row.label == DEFAULT]]
    names = []
    places = shown_places(results)
    for start in range(0, len(places), COLUMNS):
        names.append(f"scenes-{start // COLUMNS + 1}.png")
        _draw_picture(plan, rows, places[start : start + COLUMNS], out / names[-1])
    return names


def shown_places(results: Sequence[FrameResult]) -> list[int]:
    """Places evenly over those where a mirror shows something hidden, chosen by nothing else."""
    objects = [next(iter(result.objects.values()), None) for result in results]
    places = [scan.place for scan in objects if scan is not None and any(item.image.mirrored for item in scan.hidden)]
    if not places:
        return []
    return [places[index] for index in np.unique(np.linspace(0, len(places) - 1, COLUMNS * PICTURES).astype(int))]


def _draw_picture(plan: TablePlan, rows: Sequence[Row], places: Sequence[int], path: Path) -> None:
    views = [f"{row.label}: view" for row in rows]
    figure, panels = scene_panels(["scene", "map", f"{rows[0].label}: peaks", *views], len(places))
    for column, index in enumerate(places):
        _draw_column(panels[:, column], LabelledPlace(plan.seed, index, plan.effects), rows)
    legend_of_figure(figure, handles_of(*panels[2:].ravel(), *panels[0]), columns=len(places), fontsize=10)
    save(figure, path, dpi=100)


def _draw_column(panels: np.ndarray, place: LabelledPlace, rows: Sequence[Row]) -> None:
    truth, ra_map = PlaceTruth.of(place), formed_map(place)
    looks = list(looks_at(place, ra_map, truth, rows, {}))
    limits = limits_of(looks[-1].frame, truth.scene)
    draw_scene(panels[0], place.player.scene)
    draw_map(panels[1], ra_map, (limits.front, max(limits.left, -limits.right)))
    nothing = np.zeros((0, 2))
    draw_peaks(panels[2], truth.points, answer_of(looks[0].peaks, nothing, np.zeros(0, bool)))
    for axes, look in zip(panels[3:], looks, strict=True):
        draw_view(axes, look.frame, truth.scene, limits, LIMIT_RAD)
        for text in axes.texts:
            # names of objects may leave their panel: it keeps its size
            text.set_in_layout(False)
    for axes in panels:
        label = axes.get_ylabel()
        finish(axes, limits)
        axes.set(xlabel="", ylabel=label, title="")
    panels[0].set_title(f"place {place.index}: {place.player.scene.name}", fontsize=11)
