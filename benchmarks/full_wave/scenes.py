"""Miniature scenes for both solvers: surfaces as the product describes them, and the same walls as solids on a grid.

Plan view in the radar's frame: x forward, y left; radar and line source at the origin. Walls are as thick as the
product says they are, so that their fronts and ends stand where the product has them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.full_wave.line_source import ABSORBER, CONDUCTOR_PERMITTIVITY, LineGrid
from lab.full_wave.rough import is_conductor
from models.physics.curved_mirror import arc_from_ends
from models.physics.materials import permittivity
from msgs.values.radar import RadarParams
from sim_player.scene.description import Scene, SceneObject, Surface
from sim_player.scene.world import World, prepare

RADAR = RadarParams()
#: Of walls, in wavelengths.
THICKNESS = 5.0
#: Size of the sphere that stands for a thread in the product's scene, the least one: it blocks no path but its own.
THREAD_SIZE_M = 0.05
#: A target is one node of this: so weak that its echo of its own echo in a wall lies 40 dB below its mirror image.
THREAD_PERMITTIVITY = 3.0
Point = tuple[float, float]


@dataclass(frozen=True)
class Box:
    """A solid with sides along the axes."""

    low_m: Point
    high_m: Point

    def share(self, x_m: np.ndarray, y_m: np.ndarray, cell_m: float) -> np.ndarray:
        """Return the share of every cell that is solid, [nx, ny]; exact."""
        return _overlap(x_m, self.low_m[0], self.high_m[0], cell_m) * _overlap(
            y_m, self.low_m[1], self.high_m[1], cell_m
        )


@dataclass(frozen=True)
class ArcShell:
    """An arc, as the product gives it by ends and curvature, of a thickness away from the origin."""

    a_m: Point
    b_m: Point
    curvature_per_m: float
    thickness_m: float = THICKNESS * RADAR.wavelength_m

    def share(self, x_m: np.ndarray, y_m: np.ndarray, cell_m: float) -> np.ndarray:
        """Return the share of every cell that is solid, [nx, ny], by the distance of its middle from the faces."""
        centre, radius_m, *turns = arc_from_ends(np.array(self.a_m), np.array(self.b_m), self.curvature_per_m)
        outwards = math.hypot(*centre) < radius_m
        inner = radius_m if outwards else radius_m - self.thickness_m
        away, middle = np.hypot(x_m - centre[0], y_m - centre[1]), 0.5 * sum(turns)
        turn = np.angle(np.exp(1j * (np.arctan2(y_m - centre[1], x_m - centre[0]) - middle)))
        half_turn = 0.5 * abs(turns[1] - turns[0])
        radial = _overlap(away, inner, inner + self.thickness_m, cell_m)
        return radial * np.clip((half_turn - np.abs(turn)) * away / cell_m + 0.5, 0.0, 1.0)


Solid = Box | ArcShell


@dataclass(frozen=True)
class MiniScene:
    """One scene: surfaces for rays, solids for the grid, threads as targets, and how far waves are followed."""

    name: str
    about: str
    surfaces: tuple[Surface, ...]
    solids: tuple[Solid, ...]
    material: str
    low_m: Point
    high_m: Point
    #: Longest round trip [m] that is recorded.
    longest_m: float
    targets: dict[str, Point] = field(default_factory=dict)

    def grid(self, cells_per_wavelength: float) -> LineGrid:
        """Return the cells; the origin is a node, absorbers lie outside low..high."""
        cell_m = RADAR.wavelength_m / cells_per_wavelength
        first = [math.floor(low / cell_m) - ABSORBER.cells - 1 for low in self.low_m]
        last = [math.ceil(high / cell_m) + ABSORBER.cells + 1 for high in self.high_m]
        low_m = (first[0] * cell_m, first[1] * cell_m)
        return LineGrid(low_m, (last[0] - first[0] + 1, last[1] - first[1] + 1), cell_m, RADAR.carrier_hz)

    def media(self, grid: LineGrid, target: str | None) -> np.ndarray:
        """Return the permittivity at all nodes, complex64 [nx, ny]; good conductors fill whole cells."""
        solid_eps = permittivity(self.material, RADAR.carrier_hz)
        share = np.zeros(grid.cells)
        for solid in self.solids:
            share = np.maximum(share, solid.share(*grid.axes_m(), grid.cell_m))
        if is_conductor(solid_eps):
            share = np.floor(share + 0.5 + 1e-6)
            solid_eps = CONDUCTOR_PERMITTIVITY
        else:
            on_nodes = all(isinstance(solid, Box) for solid in self.solids)
            solid_eps = grid.permittivity(solid_eps, on_nodes)
        media = (1.0 + (solid_eps - 1.0) * share).astype(np.complex64)
        if target is not None:
            media[grid.node(self.node_m(grid, target))] = THREAD_PERMITTIVITY
        return media

    def node_m(self, grid: LineGrid, target: str) -> Point:
        """Return the node nearest to a target: there its thread stands, for both solvers."""
        x, y = (grid.cell_m * round(value / grid.cell_m) for value in self.targets[target])
        return x, y

    def world(self, target_m: Point | None) -> World:
        """Return the product's world, with one isotropic centre of 1 m^2 where a target stands.

        The structure of walls, small metal parts in space, has no counterpart in the plane.
        """
        objects = ()
        if target_m is not None:
            low_m = 1.0 - 0.5 * THREAD_SIZE_M
            sphere = SceneObject(
                primitive="sphere", size_m=(THREAD_SIZE_M,), z_m=low_m, x_m=target_m[0], y_m=target_m[1]
            )
            objects = (sphere,)
        world = prepare(Scene(name=self.name, surfaces=self.surfaces, objects=objects), 0)
        keep = world.speck_length_m > 0.0
        specks = {name: getattr(world, name)[keep] for name in vars(world) if name.startswith("speck_")}
        return replace(world, **specks, **(_isotropic(target_m) if target_m is not None else {}))


def _isotropic(target_m: Point) -> dict[str, np.ndarray]:
    """Return the centre fields of `World` of one centre at the antenna's height."""
    return {
        "centre_m": np.array([[*target_m, 1.0]]),
        # a lobe of exponent zero around each: all directions
        "centre_normals": np.array([[[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]]),
        "centre_rcs_m2": np.ones(1),
        "centre_phase_rad": np.zeros(1),
        "centre_exponent": np.zeros(1),
        "centre_floor": np.ones(1),
        "centre_object": np.zeros(1, int),
    }


def _overlap(at_m: np.ndarray, low_m: float | np.ndarray, high_m: float | np.ndarray, cell_m: float) -> np.ndarray:
    """Return the share of cells around coordinates that lies between low and high."""
    low = np.maximum(at_m - 0.5 * cell_m, low_m)
    return np.clip((np.minimum(at_m + 0.5 * cell_m, high_m) - low) / cell_m, 0.0, 1.0)


# Lengths in wavelengths from here on: faces and ends lie on nodes of every grid.


def _m(*lengths: float) -> tuple[float, ...]:
    """Return wavelengths in metres."""
    return tuple(RADAR.wavelength_m * length for length in lengths)


def _at(x: float, y: float) -> Point:
    """Return a point in metres."""
    return RADAR.wavelength_m * x, RADAR.wavelength_m * y


def _box(x: float, y: float, end_x: float, end_y: float) -> Box:
    return Box(_at(x, y), _at(end_x, end_y))


def _wall(*polyline: Point, material: str = "concrete", **options: float) -> Surface:
    """Return a wall of the scenes' thickness."""
    thickness_mm = None if material == "metal" else 1e3 * RADAR.wavelength_m * THICKNESS
    points = tuple(_at(*point) for point in polyline)
    return Surface(role="relay", material=material, polyline_m=points, thickness_mm=thickness_mm, **options)


#: In front of the facade, and behind it near the border of its shadow.
_BESIDE = {"lit": _at(35, 20), "border": _at(80, 42)}


def _facade(name: str, material: str, thickness: float, about: str, *targets: str) -> MiniScene:
    return MiniScene(
        name,
        about,
        (_wall((60, -25), (60, 35), material=material),),
        (_box(60, -25, 60 + thickness, 35),),
        material,
        _at(-5, -30),
        _at(85, 50),
        _m(240)[0],
        {name: place for name, place in _BESIDE.items() if name in targets},
    )


def _arc(name: str, radius: float, about: str) -> MiniScene:
    a, b = (60, -25), (60, 30)
    curvature_per_m = 1.0 / (RADAR.wavelength_m * radius)
    surface = _wall(a, b, curvature_per_m=curvature_per_m)
    solids = (ArcShell(_at(*a), _at(*b), curvature_per_m),)
    box = _at(-5, -30), _at(75, 35)
    return MiniScene(name, about, (surface,), solids, "concrete", *box, _m(213)[0], {"lit": _at(35, 12)})


_SINGLE = MiniScene(
    "wall",
    "one concrete wall whose ends echo after all else",
    (_wall((20, -21), (20, 26)),),
    (_box(20, -21, 25, 26),),
    "concrete",
    _at(-2, -22),
    _at(21, 27),
    _m(62)[0],
    {"lit": _at(12, 6)},
)
_CORNER = MiniScene(
    "corner",
    "two concrete walls at a right angle, the radar within",
    (_wall((60, -25), (60, 40)), _wall((60, 40), (-20, 40))),
    (_box(60, -25, 65, 45), _box(-20, 40, 65, 45)),
    "concrete",
    _at(-25, -30),
    _at(68, 48),
    _m(247)[0],
    {"lit": _at(30, 14)},
)
_HIDDEN = MiniScene(
    "hidden",
    "a concrete block hides the target, a concrete wall mirrors it",
    (_wall((80, -15), (80, 60)), _wall((25, 25), (40, 25), (40, 40), (25, 40), (25, 25))),
    (_box(80, -15, 85, 60), _box(25, 25, 40, 40)),
    "concrete",
    _at(-5, -20),
    _at(88, 65),
    _m(254)[0],
    {"hidden": _at(50, 40)},
)
#: `hidden` twice as large and of metal: what bends, mirrors and mixes lies farther apart in delay.
_STREET = MiniScene(
    "street",
    "6 x 6 m of metal: a block hides the target, a facade mirrors it",
    (
        _wall((160, -40), (160, 120), material="metal"),
        _wall((50, 50), (80, 50), (80, 80), (50, 80), (50, 50), material="metal"),
    ),
    (_box(160, -40, 165, 120), _box(50, 50, 80, 80)),
    "metal",
    _at(-10, -60),
    _at(170, 130),
    _m(510)[0],
    {"hidden": _at(100, 80)},
)


def scenes() -> tuple[MiniScene, ...]:
    """Return all scenes."""
    return (
        _SINGLE,
        _facade("facade", "concrete", THICKNESS, "a concrete facade with two ends", "lit", "border"),
        _CORNER,
        _HIDDEN,
        _STREET,
        _arc("arc", -60.0, "a concrete arc that bulges towards the radar, radius 1.8 m"),
        _arc("hollow", 80.0, "a concrete arc that is hollow towards the radar, radius 2.4 m"),
        _facade("sheet", "metal", 0.1, "a metal sheet with two ends", "border"),
    )
