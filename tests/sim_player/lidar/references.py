"""References of the photon simulation: mean histograms, and the light of the radar's labelled points."""

from __future__ import annotations

import numpy as np

from models.physics.photons.counting import expected_histogram
from models.physics.photons.optics import direct_photons
from msgs.values.lidar import LidarSetup
from msgs.values.perception import PathClass
from sim_player.lidar.optical_surfaces import Surfaces, object_albedo
from sim_player.lidar.spad import LightRoute, OpticalPaths, _delay_s, _measured, _within
from sim_player.paths.truth import visible_paths
from sim_player.scene.world import World, radar_pose, wall_lines
from sim_player.trace.path_table import Paths


def expected_histograms(lidar: LidarSetup, paths: OpticalPaths) -> np.ndarray:
    """Return the mean of `spad_histograms`, float64 [azimuth, bins]; raises ValueError for paths off the grid."""
    groups = _measured(lidar, paths)
    return np.array([expected_histogram(lidar.spad, _delay_s(group), group.photons) for group in groups])


def label_paths(world: World, lidar: LidarSetup, paths: Paths, time_s: float = 0.0) -> OpticalPaths:
    """Return one path of light for each labelled point of the radar's map, as the supplement reads.

    `paths` are the radar's, traced in `world` at the same time. Mirrored ones carry the two-bounce factor R_s^2 of
    their first wall, once for each of their mirrors; an arc counts as its chord. Labels have no normals of objects:
    objects are lit head-on. A label goes to the azimuth nearest to it.
    """
    visible = paths.take(visible_paths(world.setup, paths, lidar.grid))
    of_wall, at_wall = visible.object_index < 0, visible.surface >= 0
    albedo, factor, cosine = np.zeros(len(visible)), np.ones(len(visible)), np.ones(len(visible))
    walls = Surfaces.of_walls(world).take(visible.surface[at_wall])
    incidence = _label_cosines(world, visible.take(at_wall), time_s)
    albedo[at_wall] = walls.diffuse(incidence, lidar.spad.wavelength_m)
    factor[at_wall] = walls.mirror(incidence, lidar.spad.wavelength_m) ** (2.0 * visible.order[at_wall])
    cosine[at_wall & of_wall] = incidence[of_wall[at_wall]]
    albedo[~of_wall] = np.array([object_albedo(scene_object) for scene_object in world.scene.objects])[
        visible.object_index[~of_wall]
    ]
    range_m = 0.5 * visible.length_m
    made = OpticalPaths(
        azimuth_index=np.rint(lidar.grid.azimuth_index(visible.azimuth_rad)).astype(np.int64),
        range_m=range_m,
        photons=factor * direct_photons(lidar.spad, range_m, albedo, cosine),
        kind=visible.kind,
        route=np.where(visible.kind == PathClass.LOS, LightRoute.DIRECT, LightRoute.MIRROR).astype(np.uint8),
        object_index=visible.object_index,
    )
    return _within(made, lidar.spad)


def _label_cosines(world: World, visible: Paths, time_s: float) -> np.ndarray:
    """Return the cosine of incidence of labelled paths at their walls, from where they seem to come."""
    pose = radar_pose(world.scene, time_s)
    normal, _ = wall_lines(world, np.array([pose.x_m, pose.y_m]))
    level = pose.rotate(visible.virtual_m[:, :2]) / np.linalg.norm(visible.virtual_m, axis=1)[:, None]
    return np.minimum(np.abs(np.sum(level * normal[visible.surface], axis=1)), 1.0)
