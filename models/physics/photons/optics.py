"""Surfaces at 850 nm and the photons that come back from them: indices, Eqs. (13)-(16), and the chain of Eq. (10).

A face reflects |Gamma|^2, of which a smooth one keeps a mirror, rho_rough; of what enters `albedo` comes out. Scattered
light is Lambertian, and energy is conserved. Table 2 and a matt target of albedo 0.5, head-on at 8 m: 1.6 mW / 15 MHz
of 2.337e-19 J photons, optics 0.6 x 0.6, 0.28 detected, (5 mm / 8 m)^2: 8.986 photons a pulse; behind two bounces at
glass at 60 deg 8.986 x 0.0908^2 = 0.0742; by way of a matt wall at 5 m from a patch of 0.0625 m^2 2 m off 1.8e-7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from models.physics.fresnel import coherent_power, diffuse_share, half_space_reflection
from models.physics.materials import CONSTRUCTIONS, wall_name
from msgs.values.lidar import SpadParams

CHOICE = "engineering choice"


@dataclass(frozen=True)
class OpticalMaterial:
    """A material at 850 nm: n + jk, the share of the light inside that comes out scattered, and their sources."""

    n: float
    k: float
    albedo: float
    index_source: str = CHOICE
    albedo_source: str = CHOICE

    @property
    def index(self) -> complex:
        """n + jk in the sign of section 2.2: k > 0 absorbs."""
        return complex(self.n, self.k)


_PAINTED = "white paint, commonly quoted 0.8 to 0.9"
#: Every material of `models.physics.materials.TABLE`, and foliage. Roughness is given in the scene.
OPTICAL: dict[str, OpticalMaterial] = {
    "vacuum": OpticalMaterial(1.0, 0.0, 0.0, "definition", "definition"),
    "concrete": OpticalMaterial(1.6, 0.0, 0.35, CHOICE, "commonly quoted 0.3 to 0.4"),
    "brick": OpticalMaterial(1.6, 0.0, 0.45, CHOICE, "red brick, near infrared, commonly quoted 0.4 to 0.6"),
    "plasterboard": OpticalMaterial(1.52, 0.0, 0.85, "gypsum, measured", _PAINTED),
    "wood": OpticalMaterial(1.53, 0.0, 0.6, "cellulose, commonly quoted"),
    # soda-lime float glass; light that passes the pane is lost, the little that is scattered is dust
    "glass": OpticalMaterial(1.51, 0.0, 0.02, "soda-lime glass, measured"),
    "ceiling_board": OpticalMaterial(1.52, 0.0, 0.85, "gypsum, measured", _PAINTED),
    "chipboard": OpticalMaterial(1.53, 0.0, 0.6, "cellulose, commonly quoted"),
    "plywood": OpticalMaterial(1.53, 0.0, 0.65, "cellulose, commonly quoted"),
    "marble": OpticalMaterial(1.6, 0.0, 0.7, "calcite, mean of both axes, measured"),
    "floorboard": OpticalMaterial(1.5, 0.0, 0.5),
    # bare iron: no light that enters comes out; a rough face scatters its reflected light
    "metal": OpticalMaterial(2.95, 3.46, 0.0, "iron, Johnson and Christy 1974, between 821 and 892 nm", "opaque"),
    "very_dry_ground": OpticalMaterial(1.5, 0.0, 0.4),
    "medium_dry_ground": OpticalMaterial(1.5, 0.0, 0.25),
    "wet_ground": OpticalMaterial(1.33, 0.0, 0.15, "a film of water, measured"),
    "asphalt": OpticalMaterial(1.6, 0.0, 0.15, CHOICE, "commonly quoted 0.1 to 0.2"),
    # scatters alone: an index of 1 has no face that mirrors
    "vegetation": OpticalMaterial(1.0, 0.0, 0.5, "a volume, no face", "green leaves, commonly quoted 0.4 to 0.5"),
}

#: Share of the light that an object of a class scatters, as one matt surface: paint, tyres, clothes together. All are
#: engineering choices; the glints of varnish and windows are left out.
OBJECT_ALBEDO: dict[str, float] = {
    "car": 0.4,
    "van": 0.5,
    "truck": 0.5,
    "bus": 0.5,
    "bicycle": 0.3,
    "pedestrian": 0.4,
}


def optical_material(material: str) -> OpticalMaterial:
    """Return a wall's material, a construction's front layer or a volume at 850 nm; ValueError if it is unknown."""
    name = wall_name(material)
    return OPTICAL[CONSTRUCTIONS[name][0].material if name in CONSTRUCTIONS else name]


def matt_albedo(material: OpticalMaterial) -> float:
    """Return the share that a rough piece scatters when lit head-on: all it reflects, and its scattered inner light."""
    face = float(fresnel_power(material.index, 1.0))
    return face + (1.0 - face) * material.albedo


def fresnel_power(index: ArrayLike, cos_theta: ArrayLike) -> np.ndarray:
    """Return the power share |Gamma|^2 that a smooth face in air reflects (broadcast), Eq. (13), `index` n + jk.

    The mean (|TE|^2 + |TM|^2) / 2: of Eq. (14) as printed the two cancel at normal incidence. ValueError for no index
    or cosine.
    """
    permittivity, cos_theta = _permittivity(index), np.asarray(cos_theta, np.float64)
    te = half_space_reflection(permittivity, cos_theta, "te")
    tm = half_space_reflection(permittivity, cos_theta, "tm")
    return 0.5 * (np.square(np.abs(te)) + np.square(np.abs(tm)))


def optical_reflectance(
    index: ArrayLike,
    cos_theta: ArrayLike,
    roughness_m: ArrayLike,
    wavelength_m: float,
) -> np.ndarray:
    """Return the power share rho_opt of a bounce in the mirror's direction (broadcast), Eqs. (15)-(16)."""
    roughness_m = np.asarray(roughness_m, np.float64)
    if not np.all(np.isfinite(roughness_m) & (roughness_m >= 0.0)):
        raise ValueError(f"roughness_m must be finite and not negative, got {roughness_m!r}")
    return fresnel_power(index, cos_theta) * coherent_power(roughness_m, np.asarray(cos_theta), wavelength_m)


def diffuse_reflectance(
    index: ArrayLike,
    albedo: ArrayLike,
    cos_theta: ArrayLike,
    roughness_m: ArrayLike,
    wavelength_m: float,
) -> np.ndarray:
    """Return the scattered power share (broadcast): |Gamma|^2 (1 - rho_rough) + (1 - |Gamma|^2) albedo; ValueError."""
    albedo = _share("albedo", albedo)
    face = fresnel_power(index, cos_theta)
    scattered = diffuse_share(np.asarray(roughness_m), np.asarray(cos_theta), wavelength_m)
    return face * scattered + (1.0 - face) * albedo


def photons_per_pulse(spad: SpadParams) -> float:
    """Return the detections of a pulse if all of its light came back: E_p / E_ph, both optics, quantum efficiency."""
    optics = spad.transmit_efficiency * spad.receive_efficiency * spad.quantum_efficiency
    return spad.pulse_energy_j / spad.photon_energy_j * optics


def direct_photons(
    spad: SpadParams,
    range_m: ArrayLike,
    albedo: ArrayLike,
    cos_incidence: ArrayLike,
    spread_m: ArrayLike | None = None,
) -> np.ndarray:
    """Return mean detections per pulse of a matt surface that fills the beam, Eq. (10): albedo cos psi (a / r)^2.

    Broadcast. Via mirrors `range_m` is that of the image; `spread_m` is the beam's width per radian of divergence in
    the plane of a curved mirror (`range_m` if flat). ValueError for a range that is not positive, and shares outside
    0..1.
    """
    range_m, aperture_m = _lengths("range_m", range_m), spad.aperture_radius_m
    spread_m = range_m if spread_m is None else np.asarray(spread_m, np.float64)
    caught = aperture_m / np.hypot(range_m, aperture_m) * (aperture_m / np.hypot(spread_m, aperture_m))
    return photons_per_pulse(spad) * _share("albedo", albedo) * _share("cos_incidence", cos_incidence) * caught


def confocal_photons(
    spad: SpadParams,
    wall_range_m: ArrayLike,
    wall_albedo: ArrayLike,
    segment_m: ArrayLike,
    wall_cosine: ArrayLike,
    object_cosine: ArrayLike,
    object_area_m2: ArrayLike,
    object_albedo: ArrayLike,
) -> np.ndarray:
    """Return mean detections per pulse of a hidden patch via a matt wall (broadcast), Eqs. (8) and (10): L^-4.

    Laser and detector share one spot, pi (r delta / 2)^2 / cos psi, seen under the same cos psi, which cancels; a spot
    over the wall's end is neglected, and no segment takes more than all light. ValueError for lengths that are not
    positive, a negative area, and shares or cosines outside 0..1.
    """
    wall_range_m, segment_m = _lengths("wall_range_m", wall_range_m), _lengths("segment_m", segment_m)
    if not np.all(np.asarray(object_area_m2) >= 0.0):
        raise ValueError(f"object_area_m2 must not be negative, got {object_area_m2!r}")
    wall_albedo, object_albedo = _share("wall_albedo", wall_albedo), _share("object_albedo", object_albedo)
    facing = (
        _share("wall_cosine", wall_cosine) * _share("object_cosine", object_cosine) / (np.pi * np.square(segment_m))
    )
    # the footprint as the sensor sees it, pi (r delta / 2)^2: cos psi of footprint and of aperture cancel
    spot_m2 = np.pi * np.square(0.5 * spad.divergence_rad * wall_range_m)
    out = np.minimum(facing * object_area_m2, 1.0)
    back = np.minimum(facing * spot_m2, 1.0)
    caught = np.square(spad.aperture_radius_m) / (np.square(wall_range_m) + np.square(spad.aperture_radius_m))
    return photons_per_pulse(spad) * np.square(wall_albedo) * object_albedo * out * back * caught


def _permittivity(index: ArrayLike) -> np.ndarray:
    """Return (n - jk)^2, the sign of e^{+jwt}; ValueError unless n > 0 and k >= 0."""
    index = np.asarray(index, np.complex128)
    if not np.all(np.isfinite(index) & (index.real > 0.0) & (index.imag >= 0.0)):
        raise ValueError(f"index must be n + jk with n > 0 and k >= 0, got {index!r}")
    return np.square(np.conj(index))


def _lengths(name: str, value: ArrayLike) -> np.ndarray:
    value = np.asarray(value, np.float64)
    if not np.all(np.isfinite(value) & (value > 0.0)):
        raise ValueError(f"{name} must be finite and positive, got {value!r}")
    return value


def _share(name: str, value: ArrayLike) -> np.ndarray:
    value = np.asarray(value, np.float64)
    if not np.all((value >= 0.0) & (value <= 1.0 + 1e-12)):
        raise ValueError(f"{name} must lie in 0..1, got {value!r}")
    return value
