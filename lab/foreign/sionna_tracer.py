"""Sionna RT as a foreign tracer: the only module that imports it, and only when called (extra `foreign`)."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from lab.foreign.export import ExportedSurface
from lab.foreign.one_way import OneWayPaths
from models.physics.materials import VACUUM_PERMITTIVITY_F_PER_M
from msgs.values.units import SPEED_OF_LIGHT_MPS
from sim_player.trace.routes import NONE

#: Dr.Jit emits `fmaximum`: LLVM 15 and 16 end the process at it, 19 compiles it; those between were not tried.
MIN_LLVM = 17
REMEDY = "install libllvm19, or name its file in DRJIT_LIBLLVM_PATH"
#: A wall without a back is this thick: every material of the table absorbs 60 dB on the way to its back.
ENDLESS_M = 10.0
#: Rays that search for surfaces in sight: 8 mrad apart.
SAMPLES = 200_000
#: Also the size of the table that keeps candidates apart by their hashes; colliding candidates are lost, a few of a
#: thousand paths to hundreds of points.
MAX_PATHS = 1_000_000


class ForeignTracerMissingError(RuntimeError):
    """Sionna RT or the LLVM that it compiles with is not there; the message is one line."""


def load_sionna() -> Any:
    """Return the module `sionna.rt`; `ForeignTracerMissingError` names what is missing and what installs it."""
    try:
        # first: an LLVM that is too old ends the process, without an exception
        version = llvm_version()
        if int(version.split(".")[0]) < MIN_LLVM:
            raise ForeignTracerMissingError(f"sionna-rt needs LLVM {MIN_LLVM} or newer, got {version}: {REMEDY}")
        return importlib.import_module("sionna.rt")
    except ModuleNotFoundError as error:
        raise ForeignTracerMissingError(
            f"the foreign tracer needs the module {error.name}: pip install 'mirrorwave[foreign]'"
        ) from None


def llvm_version() -> str:
    """Return the version of the LLVM that Dr.Jit compiles with; errors as `load_sionna`, and `ModuleNotFoundError`."""
    drjit = importlib.import_module("drjit")
    if not drjit.has_backend(drjit.JitBackend.LLVM):
        raise ForeignTracerMissingError(f"sionna-rt needs LLVM {MIN_LLVM} or newer, got none: {REMEDY}")
    return ".".join(map(str, drjit.detail.llvm_version()))


def trace_to_points(
    surfaces: tuple[ExportedSurface, ...],
    source_m: np.ndarray,
    point_m: np.ndarray,
    carrier_hz: float,
    max_bounces: int = 2,
    samples: int = SAMPLES,
) -> OneWayPaths:
    """Return all specular paths from a source [3] to points [N, 3] by `max_bounces` reflections at most.

    Single precision throughout. Surfaces are found by shooting `samples` rays, so one that is hit by none is missed;
    candidates may be lost by chance (`MAX_PATHS`). The paths themselves come from images. Same arguments, same bytes:
    Dr.Jit is left with one thread.
    `ForeignTracerMissingError` as `load_sionna`.
    """
    sionna = load_sionna()
    # with more, the ray that comes to a surface first decides its paths' order and last bits
    importlib.import_module("drjit").set_thread_count(1)
    scene = sionna.load_scene()
    scene.frequency = carrier_hz
    array = sionna.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.tx_array = scene.rx_array = array
    scene.edit(add=_objects(sionna, surfaces, carrier_hz))
    scene.add(sionna.Transmitter("antenna", position=source_m.tolist()))
    for index, position in enumerate(point_m.tolist()):
        scene.add(sionna.Receiver(f"point_{index}", position=position))
    if not len(point_m):
        return _no_paths(max_bounces)
    solved = sionna.PathSolver()(
        scene, max_depth=max_bounces, max_num_paths_per_src=MAX_PATHS, samples_per_src=samples, refraction=False
    )
    return _one_way(scene, solved, surfaces)


def _objects(sionna: Any, surfaces: tuple[ExportedSurface, ...], carrier_hz: float) -> list[Any]:
    """Return the scene objects, one for each surface, materials shared."""
    materials: dict[tuple[str, complex, float], Any] = {}
    objects = []
    for surface in surfaces:
        key = (surface.mesh.material, surface.permittivity, surface.thickness_m)
        if key not in materials:
            materials[key] = _material(sionna, f"material_{len(materials)}", surface, carrier_hz)
        objects.append(
            sionna.SceneObject(mi_mesh=_triangles(surface), name=surface.mesh.name, radio_material=materials[key])
        )
    return objects


def _material(sionna: Any, name: str, surface: ExportedSurface, carrier_hz: float) -> Any:
    """Return Sionna's own row of ITU-R P.2040 where it has the material, else our permittivity."""
    thickness_m = min(surface.thickness_m, ENDLESS_M)
    table = importlib.import_module("sionna.rt.radio_materials.itu").ITU_MATERIALS_PROPERTIES
    if surface.mesh.material in table:
        return sionna.ITURadioMaterial(name, surface.mesh.material, thickness_m)
    conductivity = -surface.permittivity.imag * 2.0 * np.pi * carrier_hz * VACUUM_PERMITTIVITY_F_PER_M
    return sionna.RadioMaterial(
        name, thickness=thickness_m, relative_permittivity=surface.permittivity.real, conductivity=conductivity
    )


def _triangles(surface: ExportedSurface) -> Any:
    """Return the mesh in Mitsuba's form."""
    mitsuba = importlib.import_module("mitsuba")
    mesh = mitsuba.Mesh(surface.mesh.name, len(surface.mesh.vertices_m), len(surface.mesh.faces))
    arrays = mitsuba.traverse(mesh)
    arrays["vertex_positions"] = surface.mesh.vertices_m.astype(np.float32).ravel()
    arrays["faces"] = surface.mesh.faces.astype(np.uint32).ravel()
    arrays.update()
    return mesh


def _no_paths(max_bounces: int) -> OneWayPaths:
    vectors = np.zeros((0, 3))
    return OneWayPaths(
        np.zeros(0, np.int32),
        np.zeros(0),
        vectors,
        vectors,
        np.zeros(0, np.complex128),
        np.zeros((0, max_bounces), np.int32),
        np.zeros((0, max_bounces, 3)),
    )


def _one_way(scene: Any, solved: Any, surfaces: tuple[ExportedSurface, ...]) -> OneWayPaths:
    """Return the solver's padded tensors [points, 1, paths] as flat arrays; directions of travel, not of look."""
    target, _, path = np.nonzero(solved.valid.numpy())

    def flat(tensor: Any) -> np.ndarray:
        return np.asarray(tensor.numpy()[target, 0, path], np.float64)

    length_m = flat(solved.tau) * SPEED_OF_LIGHT_MPS
    real, imaginary = (part.numpy()[target, 0, 0, 0, path].astype(np.float64) for part in solved.a)
    spreading = float(scene.wavelength[0]) / (4.0 * np.pi * length_m)
    interactions = solved.interactions.numpy()[:, target, 0, path].T
    objects = solved.objects.numpy()[:, target, 0, path].T
    vertices = np.moveaxis(solved.vertices.numpy()[:, target, 0, path], 0, 1).astype(np.float64)
    number = {int(scene.objects[surface.mesh.name].object_id): index for index, surface in enumerate(surfaces)}
    known = np.vectorize(lambda identity: number.get(int(identity), NONE), otypes=[np.int32])
    surface = np.where(interactions != 0, known(objects), NONE).astype(np.int32)
    return OneWayPaths(
        target=target.astype(np.int32),
        length_m=length_m,
        depart=_direction(flat(solved.theta_t), flat(solved.phi_t)),
        arrive=-_direction(flat(solved.theta_r), flat(solved.phi_r)),
        reflection=(real + 1j * imaginary) / spreading,
        surface=surface,
        vertex_m=vertices,
    )


def _direction(zenith_rad: np.ndarray, azimuth_rad: np.ndarray) -> np.ndarray:
    """Return unit vectors [N, 3]."""
    level = np.sin(zenith_rad)
    return np.column_stack([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad), np.cos(zenith_rad)])
