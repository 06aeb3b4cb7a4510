"""Pictures of maps, views and scenes where a notebook shows a value.

Values know nothing of plots, so that IPython is told here how to show them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from msgs.values.perception import BevFrame
    from msgs.values.radar import RangeAzimuthMap
    from sim_player.scene.description import Scene


def show_values_as_pictures() -> None:
    """Register the pictures with the IPython that runs this process; without one, do nothing."""
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    formatter = shell.display_formatter.formatters.get("image/png") if shell is not None else None
    if formatter is None:
        return
    for (module, name), draw in PICTURES.items():
        # by name: what is not imported yet need not be
        formatter.for_type_by_name(module, name, draw)


def map_png(ra_map: RangeAzimuthMap) -> bytes:
    """Return a map in the plane, its level over the noise."""
    from mirrorwave.plots.bird_eye_view import map_figure
    from mirrorwave.plots.style import png

    return png(map_figure(ra_map))


def frame_png(frame: BevFrame) -> bytes:
    """Return a bird's-eye view."""
    from mirrorwave.plots.bird_eye_view import bev_figure
    from mirrorwave.plots.style import png

    return png(bev_figure(frame))


def scene_png(scene: Scene) -> bytes:
    """Return a scene from above."""
    from mirrorwave.plots.scene import scene_figure
    from mirrorwave.plots.style import png

    return png(scene_figure(scene))


#: Module and name of a type, and what draws its values.
PICTURES: dict[tuple[str, str], Callable[[Any], bytes]] = {
    ("msgs.values.radar", "RangeAzimuthMap"): map_png,
    ("msgs.values.perception", "BevFrame"): frame_png,
    ("sim_player.scene.description", "Scene"): scene_png,
}
