"""The ground as a mirror under every way to an object, straight or by one wall: echoes of three ways beside the first.

Level ground at height 0; the wave is polarised in the plane of incidence there (TM). The bounce on the ground does not
change the plan of a way, only its heights. Of each chain of walls: ground on one way (twice, either may), or on both.
"""

from __future__ import annotations

import numpy as np

from models.physics.fresnel import coherent_power, half_space_reflection
from models.physics.materials import permittivity
from sim_player.effects.names import bit
from sim_player.scene.description import Surface
from sim_player.scene.world import Snapshot, World
from sim_player.trace.echoes import Echoes, cofocal, join_echoes, object_echoes, same_target
from sim_player.trace.routes import Routes, dot, join_routes, make_routes, norm, plane_bounces
from sim_player.trace.segments import Occlusion, free_segments
from sim_player.trace.snapshot import TraceContext


def absent(world: World) -> str | None:
    """A ground and something to see in it."""
    if world.ground is None:
        return "the scene has no ground"
    return None if len(world.centre_m) else "the scene holds no object"


def apply(tracing: TraceContext) -> Echoes:
    """Straight and once mirrored ways with the ground on one of the two legs, or on both."""
    view = tracing.view
    ground = join_routes([_straight(view, tracing.owner), _mirrored(view, tracing.owner)])
    tracing.routes["ground_bounce"] = ground
    clear = tracing.clear_routes("los_objects", "specular_relay")
    # the same chain of walls: target and wall agree
    walls = len(view.world.wall_a) + 1
    mine, other = (routes.target.astype(np.int64) * walls + routes.wall + 1 for routes in (ground, clear))
    first, second = same_target(mine, other)
    both = join_routes([ground, clear])
    mixed = object_echoes(view, both, (first, second + len(ground)), bit("ground_bounce"))
    return join_echoes([object_echoes(view, ground, cofocal(ground), bit("ground_bounce")), mixed])


def _straight(view: Snapshot, owner: np.ndarray) -> Routes:
    """Antenna -> ground -> centre."""
    end = view.centre
    share = view.antenna[2] / (view.antenna[2] + end[:, 2])
    plan = view.origin + share[:, None] * (end[:, :2] - view.origin)
    bounce = np.column_stack([plan, np.zeros(len(end))])
    occlusion = free_segments((view.antenna, bounce, end), view.blockers, owner)
    ray = end * [1.0, 1.0, -1.0] - view.antenna
    return _finish(view, np.arange(len(end)), ray, ray, occlusion, 0).take(occlusion.free)


def _mirrored(view: Snapshot, owner: np.ndarray) -> Routes:
    """Antenna -> wall and ground, in the order that heights decide -> centre."""
    world, centre = view.world, view.centre
    low = centre * [1.0, 1.0, -1.0]
    wall_bounces = plane_bounces(view, view.antenna, low, world.is_flat)
    end, image = centre[wall_bounces.target], wall_bounces.image
    reach = norm(wall_bounces.specular[:, :2] - view.origin)
    total = norm(image[:, :2] - view.origin)
    at_wall = reach / total
    at_ground = view.antenna[2] / (view.antenna[2] + end[:, 2])
    wall_point = np.column_stack([wall_bounces.specular[:, :2], np.abs(wall_bounces.specular[:, 2])])
    unfolded = view.antenna + at_ground[:, None] * (image - view.antenna)
    # beyond the wall the unfolded plan is folded back to the real one
    real = np.where((at_ground < at_wall)[:, None], unfolded[:, :2], _fold(view, wall_bounces.wall, unfolded[:, :2]))
    ground_point = np.column_stack([real, np.zeros(len(real))])
    early = (at_ground < at_wall)[:, None]
    bounce_1, bounce_2 = np.where(early, ground_point, wall_point), np.where(early, wall_point, ground_point)
    occlusion = free_segments((view.antenna, bounce_1, bounce_2, end), view.blockers, owner[wall_bounces.target])
    below_top = wall_point[:, 2] < world.wall_height_m[wall_bounces.wall]
    ray = image - view.antenna
    arrive = ray.copy()
    arrive[:, :2] -= 2.0 * dot(ray[:, :2], wall_bounces.normal)[:, None] * wall_bounces.normal
    cosine = np.abs(dot(ray[:, :2], wall_bounces.normal)) / norm(ray)
    routes = _finish(
        view, wall_bounces.target, ray, arrive, occlusion, bit("specular_relay"), wall_bounces.wall, cosine
    )
    return routes.take(occlusion.free & below_top)


def _finish(
    view: Snapshot,
    target: np.ndarray,
    ray: np.ndarray,
    arrive: np.ndarray,
    occlusion: Occlusion,
    needs: int,
    wall: np.ndarray | None = None,
    cosine: np.ndarray | None = None,
) -> Routes:
    """Routes of unfolded rays [N, 3] that meet the ground once, and perhaps one wall."""
    length = norm(ray)
    whole, front, rough = (1.0, 1.0, 1.0) if wall is None or cosine is None else view.world.reflection(wall, cosine)
    at_ground, left = _ground_reflection(view.world, np.abs(ray[:, 2]) / length)
    return make_routes(
        target,
        length,
        ray / length[:, None],
        # it rises to its target after the bounce
        arrive * [1.0, 1.0, -1.0] / length[:, None],
        occlusion,
        needs | bit("ground_bounce"),
        wall=-1 if wall is None else wall,
        ground=True,
        whole=whole * at_ground,
        front=front * at_ground,
        rough=rough * left,
    )


def _ground_reflection(world: World, cosine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """TM reflection of the ground, and the field that its roughness leaves."""
    ground = world.ground
    assert isinstance(ground, Surface)
    # Eq. (13) gives TM the sign of the magnetic field; the upright electric field above the ground follows it
    reflection = half_space_reflection(np.asarray(permittivity(ground.material, world.radar.carrier_hz)), cosine, "tm")
    left = np.sqrt(coherent_power(np.array(1e-3 * ground.roughness_mm), cosine, world.radar.wavelength_m))
    return reflection, left


def _fold(view: Snapshot, wall: np.ndarray, plan: np.ndarray) -> np.ndarray:
    """Plan points mirrored in their walls."""
    normal = view.normal[wall]
    return np.asarray(plan - 2.0 * (dot(plan, normal) + view.offset[wall])[:, None] * normal)
