"""Ground truth of a scene: visible scattering centres that a map can resolve, images and their true positions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from models.physics.antenna import setup_weights, two_way_pattern
from models.physics.waveform import window_noise_gain
from msgs.values.frames import Pose2
from msgs.values.perception import PathClass, SceneTruth, TruthObject, TruthSurface
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from sim_player.scene.world import World, radar_pose
from sim_player.signal.fmcw import departure
from sim_player.trace.effect_names import PLUGGED_IN, bits
from sim_player.trace.path_table import Paths

#: Truth points differ by at least this many cells in range or in azimuth.
SEPARATION_CELLS = 4.0
#: Least SNR of a visible centre: its own beam power over a beam's noise.
VISIBLE_SNR_DB = 10.0


#: Effects whose paths a map shows too, but that have no truth points: mixed routes, diffraction, interreflection, ...
UNLABELLED = bits(
    frozenset(
        {
            *("non_cofocal", "edge_diffraction", "mirrored_diffraction"),
            *("object_interreflection", "wall_transmission", "ground_bounce"),
            *PLUGGED_IN,
        }
    )
)


def labelled(paths: Paths) -> np.ndarray:
    """Return which paths can have truth points: objects and walls in direct sight, objects by one or two mirrors."""
    plain = (paths.needs & np.uint32(UNLABELLED)) == 0
    return np.asarray(plain & ((paths.kind == PathClass.LOS) | (paths.object_index >= 0)))


def may_be_seen(setup: RadarSetup, paths: Paths, most: np.ndarray) -> np.ndarray:
    """Return which paths truth is made of, bool [P]: objects, walls over the noise; `most`: fields, sqrt(mW)."""
    visible = np.square(most) > _noise_mw(setup) * 10.0 ** (VISIBLE_SNR_DB / 10.0)
    return labelled(paths) & ((paths.object_index >= 0) | visible)


def best_power_mw(setup: RadarSetup, paths: Paths) -> np.ndarray:
    """Return the power of each path in its best beam, mW, [paths]."""
    pattern = two_way_pattern(setup, setup_weights(setup), paths.azimuth_rad, paths.elevation_rad, *departure(paths))
    return np.abs(paths.amplitude) ** 2 * (np.abs(pattern) ** 2).max(axis=0)


def visible_paths(
    setup: RadarSetup, paths: Paths, grid: RangeAzimuthGrid | None = None, clutter_mw: np.ndarray | None = None
) -> np.ndarray:
    """Return the indices of the truth points, strongest first: in the grid, over the noise, thinned greedily.

    Noise: the receiver's, and the air's echoes in the next beam, [beams, bins].
    """
    grid = setup.map_grid if grid is None else grid
    power = best_power_mw(setup, paths)
    row, column, inside = _cells(paths, grid)
    noise_mw: np.ndarray | float = _noise_mw(setup)
    if clutter_mw is not None:
        beam = np.abs(paths.azimuth_rad[:, None] - setup.beams.azimuth_rad).argmin(axis=1)
        cell = np.clip(np.rint(row), 0, clutter_mw.shape[1] - 1).astype(int)
        noise_mw = noise_mw + clutter_mw[beam, cell] / window_noise_gain("hann")
    strong = power > noise_mw * 10.0 ** (VISIBLE_SNR_DB / 10.0)
    candidates = np.flatnonzero(labelled(paths) & inside & strong)
    candidates = candidates[np.argsort(-power[candidates], kind="stable")]
    return candidates[thin(row[candidates], column[candidates])]


def _noise_mw(setup: RadarSetup) -> float:
    """Return the noise of one beam in one range bin."""
    return setup.radar.noise_power_mw / (setup.radar.samples_per_chirp * setup.radar.chirps_per_beam)


def _cells(paths: Paths, grid: RangeAzimuthGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the range and azimuth index of each path, and whether they lie in the grid."""
    row, column = grid.range_index(0.5 * paths.length_m), grid.azimuth_index(paths.azimuth_rad)
    return row, column, (row <= grid.range_bins - 1) & (column >= 0.0) & (column <= grid.azimuth_bins - 1)


def thin(row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Thin points greedily, first come first kept: indices of cells 4 apart in one coordinate from all kept ones."""
    kept: list[int] = []
    free = np.ones(len(row), bool)
    for index in range(len(row)):
        if free[index]:
            kept.append(index)
            free &= (np.abs(row - row[index]) >= SEPARATION_CELLS) | (
                np.abs(column - column[index]) >= SEPARATION_CELLS
            )
    return np.array(kept, int)


def scene_truth(
    world: World,
    setup: RadarSetup,
    paths: Paths,
    time_s: float,
    stamp_ns: int,
    scan_id: int,
    start_from_radar: Pose2 | None = None,
    clutter_mw: np.ndarray | None = None,
) -> SceneTruth:
    """Return the truth of one instant in the radar's frame (heights above the antenna); velocities are over ground.

    `start_from_radar`: None: the pose from the scene's `ego`. `clutter_mw` as of `visible_paths`.
    """
    pose = radar_pose(world.scene, time_s) if start_from_radar is None else start_from_radar
    radar_from_start = pose.inverse()
    visible = paths.take(visible_paths(setup, paths, clutter_mw=clutter_mw))
    mirrored = visible.take(visible.kind == PathClass.MIRRORED)
    return SceneTruth(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        los_points_m=visible.point_m[visible.kind == PathClass.LOS].astype(np.float32),
        mirrored_points_m=mirrored.virtual_m.astype(np.float32),
        hidden_points_m=mirrored.point_m.astype(np.float32),
        hidden_object=mirrored.object_index.astype(np.int32),
        objects=true_objects(world, paths, time_s, radar_from_start),
        surfaces=_surfaces(world, radar_from_start),
    )


def hidden_objects(paths: Paths) -> frozenset[int]:
    """Return the objects seen in a mirror and not directly."""
    return objects_of(paths, PathClass.MIRRORED) - objects_of(paths, PathClass.LOS)


def objects_of(paths: Paths, kind: PathClass) -> frozenset[int]:
    """Return the objects that paths of a kind lead to."""
    paths = paths.take(labelled(paths))
    return frozenset(paths.object_index[paths.kind == kind].tolist()) - {-1}


@dataclass(frozen=True)
class ObjectImages:
    """Visibility of each of N objects before any detection."""

    #: Some part is in direct sight; some mirror shows a part, wherever its image lies. bool [N].
    direct: np.ndarray
    mirrored: np.ndarray
    #: Strongest scattering centre among the images in the map, over the noise of its best beam, dB [N];
    #: -inf where the map holds no image. The second is that of images by one mirror.
    snr_db: np.ndarray
    single_snr_db: np.ndarray


def object_images(setup: RadarSetup, paths: Paths, count: int) -> ObjectImages:
    """Summarise the labelled paths of a scene's `count` objects."""
    paths = paths.take(labelled(paths))
    with np.errstate(divide="ignore"):
        snr_db = 10.0 * np.log10(best_power_mw(setup, paths) / _noise_mw(setup))
    image = (paths.kind == PathClass.MIRRORED) & (paths.object_index >= 0)
    shown = image & _cells(paths, setup.map_grid)[2]
    return ObjectImages(
        direct=np.bincount(
            paths.object_index[(paths.kind == PathClass.LOS) & (paths.object_index >= 0)], minlength=count
        )
        > 0,
        mirrored=np.bincount(paths.object_index[image], minlength=count) > 0,
        snr_db=_strongest(paths.object_index[shown], snr_db[shown], count),
        single_snr_db=_strongest(
            paths.object_index[shown & (paths.order == 1)], snr_db[shown & (paths.order == 1)], count
        ),
    )


def _strongest(object_index: np.ndarray, snr_db: np.ndarray, count: int) -> np.ndarray:
    """Return the largest value of each object [count]; -inf where it has none."""
    strongest = np.full(count, -np.inf)
    np.maximum.at(strongest, object_index, snr_db)
    return strongest


def true_objects(world: World, paths: Paths, time_s: float, radar_from_start: Pose2) -> tuple[TruthObject, ...]:
    """Return all objects of the scene in the radar's frame at a time."""
    hidden = hidden_objects(paths)
    objects = []
    for index, scene_object in enumerate(world.scene.objects):
        velocity = world.velocity_mps[index]
        x, y = radar_from_start.apply(np.array([scene_object.x_m, scene_object.y_m]) + velocity * time_s)
        vx, vy = radar_from_start.rotate(velocity)
        objects.append(
            TruthObject(
                id=index,
                object_class=scene_object.object_class,
                x_m=float(x),
                y_m=float(y),
                length_m=scene_object.kind.length_m,
                width_m=scene_object.kind.width_m,
                yaw_rad=math.remainder(math.radians(scene_object.yaw_deg) + radar_from_start.yaw_rad, 2.0 * math.pi),
                velocity_x_mps=float(vx),
                velocity_y_mps=float(vy),
                hidden=index in hidden,
            )
        )
    return tuple(objects)


def _surfaces(world: World, radar_from_start: Pose2) -> tuple[TruthSurface, ...]:
    """Return all walls in the radar's frame."""
    walls = [surface for surface in world.scene.surfaces if surface.role != "ground"]
    return tuple(
        TruthSurface(
            role=surface.role,
            material=surface.material,
            polyline_m=msgspec.convert(
                radar_from_start.apply(np.array(surface.polyline_m)).tolist(), tuple[tuple[float, float], ...]
            ),
        )
        for surface in walls
    )
