"""One scan of a scene at rest at the kernel level, with its labels: the record of each scene in a data set.

Basic effects give the signal of `sim_player.signal.fmcw` at a thousandth of the work; others
`sim_player.signal.levels`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal

import msgspec
import numpy as np

from models.physics.waveform import range_profile, window_noise_gain
from msgs.values.frames import Pose2
from msgs.values.perception import TruthObject
from msgs.values.radar import RadarSetup
from msgs.values.units import ratio_from_db
from sim_player.effects.table import ALL_EFFECTS
from sim_player.paths.ray_tracing import BASIC_EFFECTS, trace
from sim_player.paths.truth import best_power_mw, hidden_objects, true_objects, visible_paths
from sim_player.planner.plan import Plan, air_power_mw, manual_plan, plan_world
from sim_player.planner.plan import clean_profiles as planned_echoes
from sim_player.planner.purposes import purpose_of
from sim_player.scene.description import Scene
from sim_player.scene.world import prepare
from sim_player.signal.fmcw import beam_weights
from sim_player.signal.levels import RANGE_BINS, kernel_objections, noise_profiles
from sim_player.signal.switches import IDEAL
from sim_player.trace.path_table import Paths

WINDOW = "hann"
#: The receiver of the basic signal chain: its converter does not round.
THERMAL = msgspec.structs.replace(IDEAL, thermal_noise=True)
#: Effects: as planned under a budget, all, the plain signal chain, or by name.
EffectChoice = Literal["auto", "all", "basic"] | frozenset[str]
#: Effects of the basic signal chain: its paths, the array as built, thermal noise.
BASIC_USED = BASIC_EFFECTS | {"element_pattern", "quantised_phases", "thermal_noise"}
#: Class of a labelled point that belongs to no object.
WALL = "wall"


@dataclass(frozen=True)
class Labels:
    """Truth points of one scene, strongest first, N of them: one for each LOS or mirrored echo that can be resolved."""

    range_m: np.ndarray
    azimuth_rad: np.ndarray
    #: `PathClass` values, uint8.
    path_class: np.ndarray
    #: True position of each point in the radar's frame, [N, 2]; a direct point's own.
    hidden_xy_m: np.ndarray
    #: Power in the beam that sees it best.
    power_mw: np.ndarray
    #: Number of mirrors on the path, 0 in direct sight; uint8.
    order: np.ndarray
    #: Its cell of the range-azimuth map, int32.
    range_bin: np.ndarray
    azimuth_bin: np.ndarray
    #: True and apparent position of the scatterer in the radar's frame (z above the antenna), float32 [N, 3].
    point_m: np.ndarray
    image_m: np.ndarray
    #: Index into the scene's objects, -1 for a wall, int32; and its class.
    object_index: np.ndarray
    object_class: np.ndarray


#: Names of the labels' arrays.
LABELS = tuple(field.name for field in fields(Labels))


@dataclass(frozen=True)
class LabelledScan:
    """Profiles complex64 [beams, 512] with noise, labels, and their effects and plan."""

    profiles: np.ndarray
    labels: Labels
    noise_power_mw: float
    #: Objects seen in a mirror and not directly.
    hidden: tuple[int, ...]
    #: All objects in the radar's frame, in the order of the scene.
    objects: tuple[TruthObject, ...]
    #: Effects in the signal, paths it is made of.
    used: frozenset[str]
    paths: int
    #: None for the basic effects.
    plan: Plan | None = None


def clean_profiles(setup: RadarSetup, paths: Paths, range_bins: int = RANGE_BINS) -> np.ndarray:
    """Return the windowed range profiles of all beams without noise, sqrt(mW), complex128 [beams, bins]."""
    return beam_weights(setup, paths) @ range_profile(setup.radar, paths.length_m, range_bins, WINDOW)


def profile_noise(setup: RadarSetup, seed: int, range_bins: int = RANGE_BINS) -> np.ndarray:
    """Return the thermal noise of all beams as the profiles see it, and nothing else of the receiver; [beams, bins]."""
    return noise_profiles(setup, seed, THERMAL, range_bins=range_bins)


def noise_power_mw(setup: RadarSetup) -> float:
    """Return the mean thermal noise power of one profile bin, mW."""
    radar = setup.radar
    return radar.noise_power_mw * window_noise_gain(WINDOW) / (radar.samples_per_chirp * radar.chirps_per_beam)


def labelled_scan(
    scene: Scene,
    seed: int,
    choice: EffectChoice = "auto",
    budget_db: float = -20.0,
    gain_db: float = 0.0,
    purpose: str = "objects",
) -> LabelledScan:
    """Return one scan as a data set stores it, "auto" planned for a purpose; ValueError for a scene that moves."""
    if scene.moves:
        raise ValueError(f"scene {scene.name!r} must be at rest for the kernel level, got one that moves")
    gain, front_end, planned_for = ratio_from_db(gain_db), scene.radar.front_end, purpose_of(purpose)
    # the planner needs the level; the basic chain scales its profiles instead
    setup = scene.setup if choice == "basic" else stronger(scene.setup, gain)
    world = prepare(scene, seed, setup)
    classes = tuple(scene_object.object_class for scene_object in scene.objects)
    if choice == "basic":
        plan, paths = None, trace(world)
        profiles = np.sqrt(gain) * clean_profiles(setup, paths) + profile_noise(setup, seed)
        labels = label_points(setup, paths, gain, classes)
    else:
        if choice == "auto":
            plan = plan_world(world, setup, budget_db, purpose=planned_for, profiles_only=True)
        else:
            plan = manual_plan(world, setup, ALL_EFFECTS if choice == "all" else frozenset(choice))
        paths = plan.labelled
        # the converter only where this level can hold it
        if objections := kernel_objections(setup, plan.paths, plan.signal, front_end):
            plan = without_converter(plan, "; ".join(objections))
        profiles = planned_echoes(plan, setup, seed) + noise_profiles(setup, seed, plan.signal, front_end)
        labels = label_points(setup, paths, 1.0, classes, air_power_mw(plan, setup))
    return LabelledScan(
        profiles=profiles.astype(np.complex64),
        labels=labels,
        noise_power_mw=noise_power_mw(setup),
        hidden=tuple(sorted(hidden_objects(paths))),
        objects=true_objects(world, paths, 0.0, Pose2()),
        used=BASIC_USED if plan is None else plan.used,
        paths=len(paths),
        plan=plan,
    )


def label_points(
    setup: RadarSetup,
    paths: Paths,
    gain: float = 1.0,
    classes: tuple[str, ...] | None = None,
    clutter_mw: np.ndarray | None = None,
) -> Labels:
    """Return the truth points of traced paths as training labels; `classes` are those of the objects, in order."""
    visible = paths.take(visible_paths(setup, paths, clutter_mw=clutter_mw))
    grid = setup.map_grid
    names = np.array([*(classes or ["object"] * (int(visible.object_index.max(initial=-1)) + 1)), WALL])
    return Labels(
        range_m=(0.5 * visible.length_m).astype(np.float32),
        azimuth_rad=visible.azimuth_rad.astype(np.float32),
        path_class=visible.kind,
        hidden_xy_m=visible.point_m[:, :2].astype(np.float32),
        power_mw=(gain * best_power_mw(setup, visible)).astype(np.float32),
        order=visible.order.astype(np.uint8),
        range_bin=np.rint(grid.range_index(0.5 * visible.length_m)).astype(np.int32),
        azimuth_bin=np.rint(grid.azimuth_index(visible.azimuth_rad)).astype(np.int32),
        point_m=visible.point_m.astype(np.float32),
        image_m=visible.virtual_m.astype(np.float32),
        object_index=visible.object_index.astype(np.int32),
        object_class=names[visible.object_index],
    )


def without_converter(plan: Plan, reason: str) -> Plan:
    """Return a plan whose converter is ideal, and why: rounding or clipping that this level cannot hold."""
    left_out = {"used": False, "reason": f"left out at the kernel level: {reason}"}
    effects = (
        msgspec.structs.replace(effect, **left_out) if effect.name == "adc" else effect for effect in plan.effects
    )
    return replace(plan, effects=tuple(effects))


def stronger(setup: RadarSetup, gain: float) -> RadarSetup:
    """Return a set-up whose transmitter has so much more power."""
    radar = msgspec.structs.replace(setup.radar, transmit_power_w=gain * setup.radar.transmit_power_w)
    return msgspec.structs.replace(setup, radar=radar)
