"""Runs sensors over sweeps of scenes: the same scene, seed and viewpoint for all. One file a scene: a run goes on.

A sensor that cannot look at a scene keeps the reason in its place.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from lab.compare.comparison_scenes import (
    WALLS,
    Corner,
    MirrorPath,
    ShownPoints,
    comparison_place,
    corner_scene,
    incidences,
    mirror_path,
    shown_points,
)
from lab.compare.peak_scores import Score, score
from lab.compare.sensors import SENSORS, Equal, Sensor
from lab.studies.resumable import ResumableRun, charged
from msgs.values.units import db_from_ratio
from sim_player.dataset.executors import map_jobs
from sim_player.generate.places import PLACE_KINDS
from sim_player.scene.description import Scene

Value = float | str


@dataclass(frozen=True)
class Sweep:
    """Varied quantity: values of a quick run and of a whole one, and the scene of a value."""

    title: str
    quick: tuple[Value, ...]
    whole: tuple[Value, ...]
    scene: Callable[[Value, int, int], Scene]

    @property
    def is_corner(self) -> bool:
        """True if its scenes have one relay wall and one object, for which a closed form holds."""
        return self.scene is not _place


def _place(value: Value, seed: int, viewpoint: int) -> Scene:
    kind = next((kind for kind in PLACE_KINDS if kind == value), None)
    if kind is None:
        raise ValueError(f"a place must be one of {', '.join(PLACE_KINDS)}, got {value!r}")
    return comparison_place(seed, viewpoint, kind)


def _corner(field: str, **fixed: Value) -> Callable[[Value, int, int], Scene]:
    """Corners of which one field is the sweep's value."""
    return lambda value, seed, viewpoint: corner_scene(
        msgspec.convert({**fixed, field: value}, Corner), seed, viewpoint
    )


#: About the 10 m of Table 2's period more closely than elsewhere.
QUICK_RANGES_M = (8.0, 12.0, 40.0, 90.0)
RANGES_M = (7.0, 8.0, 9.0, 10.0, 12.0, 15.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0, 105.0)
#: The sweeps. Range is swept three times: concrete takes the mirror from light, float glass leaves it a weak one, and
#: polished metal is the best mirror for all, so that the LiDAR's period alone can end its range.
SWEEPS: dict[str, Sweep] = {
    "range": Sweep("range to the image behind concrete [m]", QUICK_RANGES_M, RANGES_M, _corner("range_m")),
    "range_glass": Sweep(
        "range to the image behind float glass [m]", QUICK_RANGES_M, RANGES_M, _corner("range_m", wall="float_glass")
    ),
    "range_metal": Sweep(
        "range to the image behind polished metal [m]",
        QUICK_RANGES_M,
        RANGES_M,
        _corner("range_m", wall="polished_metal"),
    ),
    "roughness": Sweep(
        "rms roughness of the wall [mm]",
        (0.0, 1e-4, 0.5, 5.0),
        (0.0, 2e-5, 5e-5, 1e-4, 1.5e-4, 2e-4, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.5, 5.0),
        _corner("roughness_mm"),
    ),
    "material": Sweep("wall", ("metal", "float_glass", "concrete"), tuple(WALLS), _corner("wall")),
    "incidence": Sweep(
        "incidence at the wall [deg]",
        (20.0, 60.0),
        (15.0, 25.0, 35.0, 45.0, 55.0, 65.0, 75.0),
        _corner("incidence_deg", range_m=20.0),
    ),
    "places": Sweep("random places", PLACE_KINDS[:1], PLACE_KINDS, _place),
}


#: As files are numbered.
MAX_VIEWPOINTS = 1000


class Plan(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Plan of a run: sensors, values of each sweep, viewpoints of each value, the series."""

    seed: int
    viewpoints: int
    equal: Equal
    sensors: list[str]
    values: dict[str, list[Value]]

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")
        if not 1 <= self.viewpoints <= MAX_VIEWPOINTS:
            raise ValueError(f"viewpoints must lie in 1..{MAX_VIEWPOINTS}, got {self.viewpoints}")
        for word, names, allowed in (("sensor", self.sensors, SENSORS), ("sweep", self.values, SWEEPS)):
            if not names:
                raise ValueError(f"{word}s must name at least one, got none")
            for name in names:
                if name not in allowed:
                    raise ValueError(f"{word} must be one of {', '.join(allowed)}, got {name!r}")

    @property
    def jobs(self) -> list[tuple[str, int, int]]:
        """Every sweep, index of a value, viewpoint; in order."""
        return [
            (sweep, index, viewpoint)
            for sweep, values in self.values.items()
            for index in range(len(values))
            for viewpoint in range(self.viewpoints)
        ]


class Seen(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """View of a scene by one sensor, or why it has none."""

    failed: str | None = None
    score: Score | None = None
    #: Closed form of `score.snr_db`; None where none holds.
    predicted_snr_db: float | None = None
    #: From the scene to the map.
    seconds: float | None = None


class SceneResult(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One scene through all sensors."""

    sweep: str
    index: int
    viewpoint: int
    truth_points: int = 0
    #: Cosines of incidence at the wall: least and largest of the points shown; None where there is more than one wall.
    cos_incidence: tuple[float, float] | None = None
    seen: dict[str, Seen]


@dataclass(frozen=True)
class Job:
    """A scene of a run."""

    plan: Plan
    sweep: str
    index: int
    viewpoint: int


def run_plan(plan: Plan, out: Path, jobs: int = 1, tick: Callable[[], None] = lambda: None) -> list[SceneResult]:
    """Look at what was not looked at yet, in so many processes; the results of all scenes, in order.

    Raises `ValueError` where `out` holds another run or a damaged result, or `jobs` is less than 1.
    """
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {jobs}")
    files = {coordinates: "scenes/{}-{:03d}-{:03d}.msgpack".format(*coordinates) for coordinates in plan.jobs}
    run = ResumableRun(plan, out, SceneResult, files)
    missing = [Job(plan, *coordinates) for coordinates in run.missing(tick)]
    for result in map_jobs(run_job, missing, workers=jobs):
        run.keep((result.sweep, result.index, result.viewpoint), result)
        tick()
    return run.results()


def run_job(job: Job) -> SceneResult:
    """Look at one scene with all sensors."""
    with threadpool_limits(1, "blas"):
        return _looked(job)


def _looked(job: Job) -> SceneResult:
    plan = job.plan
    looks: dict[str, Seen] = {}
    failed: dict[str, str] = {}
    truth, mirror = None, None
    with charged(failed, *plan.sensors):
        sweep = SWEEPS[job.sweep]
        scene = sweep.scene(plan.values[job.sweep][job.index], plan.seed, job.viewpoint)
        seeds = _seeds(job)
        truth, mirror = shown_points(scene, seeds[0]), mirror_path(scene) if sweep.is_corner else None
        for name in plan.sensors:
            with charged(failed, name):
                looks[name] = look(SENSORS[name], scene, seeds, truth, mirror, plan.equal)
    return SceneResult(
        sweep=job.sweep,
        index=job.index,
        viewpoint=job.viewpoint,
        truth_points=0 if truth is None else len(truth),
        cos_incidence=None if mirror is None or not truth else incidences(scene, truth),
        seen={name: looks.get(name) or Seen(failed=failed[name]) for name in plan.sensors},
    )


def _seeds(job: Job) -> tuple[int, int]:
    """Of a scene's scatterers, the same for all values of all sweeps; and of the noise, different in every scene."""
    order = list(SWEEPS).index(job.sweep)
    scene = np.random.default_rng([job.plan.seed, job.viewpoint, 1]).integers(2**31)
    noise = np.random.default_rng([job.plan.seed, job.viewpoint, 2, order, job.index]).integers(2**31)
    return int(scene), int(noise)


def look(
    sensor: Sensor, scene: Scene, seeds: tuple[int, int], truth: ShownPoints, mirror: MirrorPath | None, equal: Equal
) -> Seen:
    """One scan of one sensor, timed, and its score; `mirror` is None where no closed form holds."""
    _warm_up(sensor.name)
    start_s = time.perf_counter()
    sight = sensor.look(scene, *seeds, equal)
    seconds = time.perf_counter() - start_s
    predicted = None if mirror is None else sensor.predicted_snr(scene, mirror, equal)
    return Seen(
        score=score(sight, scene, truth),
        predicted_snr_db=db_from_ratio(predicted) if predicted else None,
        seconds=seconds,
    )


@lru_cache
def _warm_up(name: str) -> None:
    """The first look of a process compiles and fills tables."""
    SENSORS[name].look(corner_scene(Corner()), 0, 0, "power")
