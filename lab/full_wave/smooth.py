"""Smooth walls of one material at a carrier, by finite differences and exactly: what a resolution is tried on."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from lab.full_wave.rough import RoughParams
from lab.full_wave.scattering import Scattered, reflect_angles
from models.physics.fresnel import Polarisation, slab_reflection
from models.physics.materials import permittivity
from msgs.values.units import SPEED_OF_LIGHT_MPS


@dataclass(frozen=True)
class SmoothWall:
    """A half-space (infinite thickness) or a slab in air."""

    frequency_hz: float
    material: str
    thickness_m: float
    polarisation: Polarisation

    @property
    def name(self) -> str:
        """Material, and thickness where it has one."""
        return self.material if math.isinf(self.thickness_m) else f"{self.material} {1e3 * self.thickness_m:g} mm"

    @cached_property
    def permittivity(self) -> complex:
        """Complex relative permittivity, beyond the range of the material too."""
        return complex(permittivity(self.material, self.frequency_hz, extrapolate=True))

    def exact(self, angles_rad: np.ndarray) -> np.ndarray:
        """Return the field reflection at angles from the normal, complex128 [angles]."""
        wavelength_m = SPEED_OF_LIGHT_MPS / self.frequency_hz
        eps, thickness_m = np.asarray(self.permittivity), np.asarray(self.thickness_m)
        return slab_reflection(eps, np.cos(angles_rad), thickness_m, wavelength_m, self.polarisation)

    def simulated(
        self, angles_rad: np.ndarray, cells_per_wavelength: float, dtype: str = "float64", workers: int = 2
    ) -> list[Scattered]:
        """Return the reflection by time stepping; cells count per wavelength in the material."""
        layers = ((self.permittivity, self.thickness_m),)
        settings = RoughParams(cells_per_wavelength, dtype=dtype)
        return reflect_angles(layers, angles_rad, self.frequency_hz, self.polarisation, settings, workers)


_POLARISATIONS: tuple[Polarisation, ...] = ("te", "tm")
#: Brick at 77 GHz lies between its measured bands and is interpolated.
SMOOTH_WALLS: tuple[SmoothWall, ...] = tuple(
    SmoothWall(frequency_hz, *wall, polarisation)
    for frequency_hz, wall, polarisation in product(
        (10e9, 77e9),
        (("concrete", math.inf), ("brick", math.inf), ("glass", 6e-3), ("wood", math.inf), ("metal", math.inf)),
        _POLARISATIONS,
    )
)
