"""Statistics of a data set, counted from its shards: places, walls, objects, ranges, bounces, SNR, roughness,
effects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from msgs.values.perception import PathClass
from sim_player.dataset.shards import UNREADABLE, read_shard
from sim_player.scene.description import OBJECT_KINDS

#: Edges of the histograms; the last bin takes all that lies beyond.
RANGE_EDGES_M = tuple(float(edge) for edge in range(0, 111, 5))
SNR_EDGES_DB = tuple(float(edge) for edge in range(10, 101, 5))
ROUGHNESS_EDGES_MM = (0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0, 3.0)
CLASS_NAMES = {PathClass.LOS: "LOS", PathClass.MIRRORED: "mNLOS"}
ORDER_NAMES = ("direct", "one mirror", "two mirrors")


class Histogram(msgspec.Struct, frozen=True, kw_only=True):
    """Counts between edges (one fewer), by name."""

    edges: tuple[float, ...]
    counts: dict[str, list[int]]


class ObjectCount(msgspec.Struct, frozen=True, kw_only=True):
    """Objects of one class: with direct points, with points in mirrors alone, with none."""

    direct: int = 0
    hidden: int = 0
    unseen: int = 0


class Statistics(msgspec.Struct, frozen=True, kw_only=True):
    """A data set in numbers; counts by name, largest first."""

    series: dict[str, Any]
    scenes: int
    points: dict[str, int]
    places: dict[str, int]
    #: Kinds of wall as built, and materials of all walls.
    relays: dict[str, int]
    materials: dict[str, int]
    objects: dict[str, ObjectCount]
    #: Scenes by how many objects they have, and by how many of them show in mirrors alone.
    objects_per_scene: dict[int, int]
    hidden_per_scene: dict[int, int]
    nothing_hidden_share: float
    #: Objects that only mirrors show, but none of their points stands out of the noise.
    hidden_in_noise: int
    #: Points by mirrors on their way.
    orders: dict[str, int]
    range_m: Histogram
    snr_db: Histogram
    roughness_mm: Histogram
    #: Share of scenes that use an effect.
    effects: dict[str, float]
    #: 10 %, 50 %, 90 % of the paths that are left for the signal, and of those traced, per scene.
    paths: tuple[float, float, float]
    traced: tuple[float, float, float] | None


@dataclass(frozen=True)
class SceneRecord:
    """One scene of a shard."""

    index: int
    profiles: np.ndarray
    noise_power_mw: float
    facts: dict[str, Any]
    plan: dict[str, Any]
    #: Labels by name.
    points: dict[str, np.ndarray]


#: Labels that a record carries.
_POINTS = ("range_m", "azimuth_rad", "path_class", "power_mw", "order", "object_index")


def series_of(folder: Path) -> dict[str, Any]:
    """Return the content of `series.json`; ValueError where the folder holds no data set."""
    path = folder / "series.json"
    try:
        series: dict[str, Any] = msgspec.json.decode(path.read_bytes(), type=dict)
    except (OSError, msgspec.DecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: must say which data set the folder holds: {reason}") from None
    return series


def read_records(folder: Path) -> Iterator[SceneRecord]:
    """Yield all scenes of a data set in order; ValueError for a folder without shards, or a shard that cannot be
    read.
    """
    paths = sorted(folder.glob("shard-*.npz"))
    if not paths:
        raise ValueError(f"{folder} must hold shards (shard-*.npz), found none")
    first = 0
    for path in paths:
        try:
            arrays = read_shard(path)
            records = list(_records(arrays, first))
        except UNREADABLE as error:
            raise ValueError(f"{path}: not a shard of this format: {' '.join(str(error).split())}") from None
        yield from records
        first += len(records)


def dataset_statistics(folder: Path) -> Statistics:
    """Count everything in a data set; ValueError as above."""
    return count_up(series_of(folder), read_records(folder))


def _records(arrays: dict[str, np.ndarray], first: int) -> Iterator[SceneRecord]:
    offset = arrays["offset"]
    for scene in range(len(offset) - 1):
        here = slice(int(offset[scene]), int(offset[scene + 1]))
        yield SceneRecord(
            index=first + scene,
            profiles=arrays["profiles"][scene],
            noise_power_mw=float(arrays["noise_power_mw"][scene]),
            facts=msgspec.json.decode(bytes(arrays["facts"][scene])),
            plan=msgspec.json.decode(bytes(arrays["plan"][scene])),
            points={name: arrays[name][here] for name in _POINTS},
        )


def count_up(series: dict[str, Any], records: Iterable[SceneRecord]) -> Statistics:
    """Return the statistics of records; ValueError without one."""
    counted = {name: Counter[Any]() for name in ("place", "relay", "material", "effect", "order", "objects", "hidden")}
    objects = {name: Counter[str]() for name in OBJECT_KINDS}
    range_m, snr_db = ({name: list[np.ndarray]() for name in CLASS_NAMES.values()} for _ in range(2))
    roughness_mm, paths, traced = list[float](), list[int](), list[int]()
    hidden_in_noise = 0
    for record in records:
        facts, plan, points = record.facts, record.plan, record.points
        walls = [surface for surface in facts["surfaces"] if surface["role"] != "ground"]
        roughness_mm += [wall["roughness_mm"] for wall in walls]
        paths.append(plan["paths"])
        traced += [plan["traced"]] if "traced" in plan else []
        is_mirrored = points["path_class"] == PathClass.MIRRORED
        level_db = 10.0 * np.log10(points["power_mw"] / record.noise_power_mw)
        for kind, name in CLASS_NAMES.items():
            of_class = points["path_class"] == kind
            range_m[name].append(points["range_m"][of_class])
            snr_db[name].append(level_db[of_class])
        direct = set(points["object_index"][points["path_class"] == PathClass.LOS].tolist())
        mirrored = set(points["object_index"][is_mirrored].tolist()) - direct - {-1}
        for index, name in enumerate(facts["objects"]):
            visibility = "direct" if index in direct else "hidden" if index in mirrored else "unseen"
            objects.setdefault(name, Counter())[visibility] += 1
        hidden_in_noise += len(set(facts["hidden"]) - mirrored - direct)
        for name, values in {
            "place": [facts["place"]],
            "relay": facts["relays"],
            "material": [wall["material"] for wall in walls],
            "effect": plan["used"],
            # a corner of walls returns what it bounced itself: in direct sight all the same
            "order": np.where(is_mirrored, points["order"], 0).tolist(),
            "objects": [len(facts["objects"])],
            "hidden": [len(mirrored)],
        }.items():
            counted[name].update(values)
    scenes = counted["place"].total()
    if not scenes:
        raise ValueError("a data set must hold at least one scene, got none")
    ranges = {name: np.concatenate(parts) for name, parts in range_m.items()}
    return Statistics(
        series=series,
        scenes=scenes,
        points={name: len(values) for name, values in ranges.items()},
        places=dict(counted["place"].most_common()),
        relays=dict(counted["relay"].most_common()),
        materials=dict(counted["material"].most_common()),
        objects={name: ObjectCount(**counts) for name, counts in objects.items() if counts},
        objects_per_scene=dict(sorted(counted["objects"].items())),
        hidden_per_scene=dict(sorted(counted["hidden"].items())),
        nothing_hidden_share=counted["hidden"][0] / scenes,
        hidden_in_noise=hidden_in_noise,
        orders={name: counted["order"][order] for order, name in enumerate(ORDER_NAMES)},
        range_m=histogram(RANGE_EDGES_M, ranges),
        snr_db=histogram(SNR_EDGES_DB, {name: np.concatenate(parts) for name, parts in snr_db.items()}),
        roughness_mm=histogram(ROUGHNESS_EDGES_MM, {"walls": np.array(roughness_mm)}),
        effects={name: count / scenes for name, count in counted["effect"].most_common()},
        paths=_quantiles(paths),
        traced=_quantiles(traced) if traced else None,
    )


def histogram(edges: tuple[float, ...], values: dict[str, np.ndarray]) -> Histogram:
    """Return the counts of values between edges; what lies outside goes to the first or the last bin."""
    inside = {name: np.clip(array, edges[0], np.nextafter(edges[-1], edges[0])) for name, array in values.items()}
    return Histogram(
        edges=edges, counts={name: np.histogram(array, np.array(edges))[0].tolist() for name, array in inside.items()}
    )


def _quantiles(values: list[int]) -> tuple[float, float, float]:
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
    return low, middle, high
