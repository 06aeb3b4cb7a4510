"""Whether the tags of a map say that a building stands and has walls at a car's height: one table, with its pages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from sim_player.maps.wall_rules import STOREY_M, length_m

#: Walls that begin above this pass over a car.
CAR_HEIGHT_M = 1.5

Tags = Mapping[str, str]
NO = frozenset({"", "no", "false", "0", "none"})
_GONE = ("demolished", "razed", "removed", "destroyed", "collapsed", "dismantled", "historic", "was")
_NOT_YET = ("proposed", "planned", "construction")


class _Row(NamedTuple):
    """Why a building of some tags has no wall that a car could see."""

    reason: str
    #: Pages of the wiki.
    source: str
    holds: Callable[[Tags], bool]


def _says(tags: Tags, key: str, *values: str) -> bool:
    """Return whether a tag has one of the values, or, where none is given, any that is not "no"."""
    value = tags.get(key, "no").strip().lower()
    return value in values if values else value not in NO


def _number(tags: Tags, key: str) -> float | None:
    """Return the first number of a tag, None without one."""
    try:
        return float(tags.get(key, "").split(";")[0])
    except ValueError:
        return None


def _is_gone(tags: Tags) -> bool:
    # "historic=yes" and "historic=castle" tell of buildings that stand
    words = tuple(word for word in _GONE if word not in ("historic", "was"))
    return (
        _says(tags, "building", *_GONE, "ruins", "no_longer_exists")
        or any(_says(tags, word) for word in words)
        or any(_says(tags, f"{word}:building") for word in (*_GONE, "ruins"))
        or "end_date" in tags
    )


def _is_not_yet(tags: Tags) -> bool:
    # "construction=minor" is work on a building that stands
    return (
        _says(tags, "building", *_NOT_YET)
        or any(_says(tags, word, "yes") for word in _NOT_YET)
        or any(_says(tags, f"{word}:building") for word in _NOT_YET)
    )


def _is_below_ground(tags: Tags) -> bool:
    below = (_number(tags, "building:levels:underground") or 0.0) > 0.0
    return (
        _says(tags, "location", "underground", "underwater", "indoor")
        or _says(tags, "parking", "underground")
        or (_number(tags, "layer") or 0.0) < 0.0
        or (below and _number(tags, "building:levels") == 0.0)
    )


def _is_above_a_car(tags: Tags) -> bool:
    foot_m = max(
        (length_m(tags.get(key, "")) or 0.0 for key in ("min_height", "building:min_height")),
        default=0.0,
    )
    levels = max((_number(tags, key) or 0.0 for key in ("building:min_level", "min_level")), default=0.0)
    return (
        max(foot_m, STOREY_M * levels) > CAR_HEIGHT_M
        or _says(tags, "building", "bridge", "skyway", "stilt_house")
        or _says(tags, "bridge")
        or _says(tags, "location", "overhead", "roof", "rooftop", "bridge")
    )


def _is_open(tags: Tags) -> bool:
    kinds = ("roof", "carport", "canopy", "pergola", "gazebo", "awning", "bus_shelter")
    return (
        _says(tags, "building", *kinds)
        or _says(tags, "building:part", "roof")
        or any(tags.get(key, "").strip().lower() == "no" for key in ("wall", "walls", "building:walls"))
    )


_ROWS = (
    _Row("buildings that are gone", "Lifecycle_prefix, Key:end_date, Key:ruins, Tag:building=ruins", _is_gone),
    _Row("buildings that are not built yet", "Lifecycle_prefix, Tag:building=construction", _is_not_yet),
    _Row("buildings below ground", "Key:location, Key:layer, Key:building:levels:underground", _is_below_ground),
    _Row("buildings above a car", "Key:min_height, Key:building:min_level, Tag:building=bridge", _is_above_a_car),
    _Row("roofs without walls", "Tag:building=roof, Tag:building=carport, Key:wall", _is_open),
)
#: Keys of a building: what is disused or abandoned still stands (Lifecycle_prefix).
KEYS = ("building", "disused:building", "abandoned:building")


def is_building(tags: Tags) -> bool:
    """Return whether tags are those of a building, standing or not."""
    return any(_says(tags, key) for key in KEYS)


def why_no_wall(tags: Tags) -> str | None:
    """Return why a building has no walls at the height of a car, None where it has."""
    return next((row.reason for row in _ROWS if row.holds(tags)), None)
