"""Optics at 850 nm: both forms of Eq. (14), energy that adds up, and the chain of Eq. (10) against hand numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.materials import wall_names
from models.physics.photons.optics import (
    OBJECT_ALBEDO,
    OPTICAL,
    confocal_photons,
    diffuse_reflectance,
    direct_photons,
    fresnel_power,
    matt_albedo,
    optical_material,
    optical_reflectance,
    photons_per_pulse,
)
from msgs.values.lidar import SpadParams
from sim_player.scene.description import OBJECT_KINDS

WAVELENGTH_M = 850e-9
GLASS, IRON = 1.51, 2.95 + 3.46j
COSINES = np.linspace(0.0, 1.0, 201)


def test_every_wall_and_object_class_is_known() -> None:
    for name in wall_names():
        material = optical_material(name)
        assert material.n > 0.0 <= material.k
        assert 0.0 <= material.albedo <= 1.0
        assert material.index_source
        assert material.albedo_source
    assert set(OBJECT_ALBEDO) == set(OBJECT_KINDS)
    assert optical_material("double_glazing") == optical_material("window") == OPTICAL["glass"]
    assert optical_material("container") == OPTICAL["metal"]
    with pytest.raises(ValueError, match="unknown material 'cheese'"):
        optical_material("cheese")


def test_fresnel_power() -> None:
    """Glass, n = 1.51: head-on ((n - 1) / (n + 1))^2 = 0.041285; 1 at grazing.

    At Brewster's angle, tan t = n, TM vanishes, so the mean is |TE|^2 / 2, with TE = (1 - n^2) / (1 + n^2).
    """
    assert fresnel_power(GLASS, 1.0) == pytest.approx((0.51 / 2.51) ** 2, rel=1e-14)
    assert fresnel_power(GLASS, 0.0) == pytest.approx(1.0, rel=1e-14)
    te = (1.0 - GLASS**2) / (1.0 + GLASS**2)
    brewster = 1.0 / math.hypot(1.0, GLASS)
    assert fresnel_power(GLASS, brewster) == pytest.approx(te**2 / 2.0, rel=1e-12)


def test_iron_reflects_as_its_index_says() -> None:
    """((n - 1)^2 + k^2) / ((n + 1)^2 + k^2) = 0.5721; the sign of k decides nothing of it, a wrong one is refused."""
    assert fresnel_power(IRON, 1.0) == pytest.approx((1.95**2 + 3.46**2) / (3.95**2 + 3.46**2), rel=1e-14)
    assert matt_albedo(OPTICAL["metal"]) == pytest.approx(0.5721, abs=1e-4)


@pytest.mark.parametrize("roughness_m", [0.0, 1e-8, 1e-7, 1e-4])
def test_energy_adds_up(roughness_m: float) -> None:
    """Mirror, scattered light and what stays inside, (1 - |Gamma|^2)(1 - albedo), are all that fell: to 1e-14."""
    for material in OPTICAL.values():
        args = COSINES, roughness_m, WAVELENGTH_M
        mirror = optical_reflectance(material.index, *args)
        scattered = diffuse_reflectance(material.index, material.albedo, *args)
        inside = (1.0 - fresnel_power(material.index, COSINES)) * (1.0 - material.albedo)
        np.testing.assert_allclose(mirror + scattered + inside, 1.0, rtol=0.0, atol=1e-14)


def test_a_tenth_of_a_millimetre_leaves_no_mirror() -> None:
    """g = 4 pi 0.1 mm / 850 nm = 1478: exp(-g^2) is 0, all of the face's light is scattered. 50 nm head-on: 0.5790."""
    assert optical_reflectance(GLASS, 1.0, 1e-4, WAVELENGTH_M) == 0.0
    assert diffuse_reflectance(GLASS, 0.0, 1.0, 1e-4, WAVELENGTH_M) == fresnel_power(GLASS, 1.0)
    left = optical_reflectance(GLASS, 1.0, 5e-8, WAVELENGTH_M) / fresnel_power(GLASS, 1.0)
    assert left == pytest.approx(math.exp(-((4.0 * math.pi * 50.0 / 850.0) ** 2)), rel=1e-12)


def test_worked_example_of_the_module() -> None:
    """The docstring's numbers by hand; (a / r)^2 stands for a^2 / (r^2 + a^2), 4e-7 less."""
    spad = SpadParams()
    photon_j = 6.626_070_15e-34 * 299_792_458.0 / 850e-9
    assert photon_j == pytest.approx(2.33700e-19, rel=1e-5, abs=0.0)
    assert 1.6e-3 / 15e6 / photon_j == pytest.approx(4.56427e8, rel=2e-6)
    sent = 1.6e-3 / 15e6 / photon_j * 0.6 * 0.6 * 0.28
    assert photons_per_pulse(spad) == pytest.approx(sent, rel=1e-14)
    assert sent == pytest.approx(4.60078e7, rel=1e-6)
    direct = sent * 0.5 * (5e-3 / 8.0) ** 2
    assert direct == pytest.approx(8.98590, rel=1e-6)
    assert direct_photons(spad, 8.0, 0.5, 1.0) == pytest.approx(direct, rel=1e-6)
    bounce = float(fresnel_power(GLASS, 0.5))
    assert bounce == pytest.approx(0.09084, abs=5e-6)
    assert direct * bounce**2 == pytest.approx(0.07415, abs=5e-6)
    out = 0.5 / math.pi * 0.0625 / 4.0
    back = 0.5 / math.pi * math.pi * (5.0 * 1e-3) ** 2 / 4.0
    caught = 0.5 * (5e-3 / 5.0) ** 2
    assert (out, back, caught) == pytest.approx((2.48680e-3, 3.12500e-6, 5e-7), rel=1e-5)
    found = confocal_photons(spad, 5.0, 0.5, 2.0, 1.0, 1.0, 0.0625, 0.5)
    assert found == pytest.approx(sent * out * back * caught, rel=2e-6, abs=0.0)
    assert found == pytest.approx(1.78769e-7, rel=1e-5, abs=0.0)


def test_laws_of_distance_and_angle() -> None:
    """r^-2 straight, to 2e-6 from 5 m on (the aperture's a^2 / r^2); L^-4 and both cosines squared by way of a wall;
    the wall's own distance does not matter there, as the footprint grows while its light thins."""
    spad = SpadParams()
    assert direct_photons(spad, 5.0, 0.3, 0.7) / direct_photons(spad, 20.0, 0.3, 0.7) == pytest.approx(16.0, rel=2e-6)
    assert direct_photons(spad, 5.0, 0.3, 0.7) / direct_photons(spad, 5.0, 0.6, 0.35) == pytest.approx(1.0)

    def confocal(leg_m: float = 2.0, wall: float = 1.0, thing: float = 1.0, wall_range_m: float = 8.0) -> float:
        return float(confocal_photons(spad, wall_range_m, 0.5, leg_m, wall, thing, 0.01, 0.5))

    assert confocal() / confocal(leg_m=6.0) == pytest.approx(81.0, rel=1e-12)
    assert confocal(wall=0.5) / confocal() == pytest.approx(0.25, rel=1e-12)
    assert confocal(thing=0.5) / confocal() == pytest.approx(0.25, rel=1e-12)
    assert confocal(wall_range_m=16.0) / confocal() == pytest.approx(1.0, rel=1e-6)


def exchanged(rng, start, normal, centre, facing, inside) -> tuple[float, np.ndarray]:  # type: ignore[no-untyped-def]
    """Share of the light that a matt surface throws from points [N, 3] into a target in a plane, and where it lands.

    Rays fall evenly into a cone of 0.022 rad about the target; each stands for cos / pi of the cone's solid angle.
    """
    to = centre - start
    axis = to / np.linalg.norm(to, axis=1)[:, None]
    side = np.cross(axis, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1)[:, None]
    height, turn = 1.0 - rng.random(len(start)) * (1.0 - math.cos(0.022)), rng.uniform(0.0, 2.0 * math.pi, len(start))
    out = np.sqrt(1.0 - height**2)[:, None]
    around = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(axis, side)
    ray = height[:, None] * axis + out * around
    landed = start + (to @ facing / (ray @ facing))[:, None] * ray
    hit = inside(landed)
    weight = np.where(hit, np.maximum(ray @ normal, 0.0), 0.0) * 2.0 * (1.0 - math.cos(0.022))
    return float(weight.mean()), landed[hit]


def test_confocal_chain_against_rays() -> None:
    """Rays, leg by leg: spot on a wall 2 m ahead at 50 deg, plate of 4 cm x 4 cm 1.5 m from it, spot again, aperture.

    Each leg starts from points where the last one landed. 20 mrad, aperture of 2 cm. Finite sizes: (0.02 / 1.5)^2 =
    2e-4 a leg; 80,000 of the rays of a leg land or more: 0.5 % together, fixed seed; tolerance 1.5 %.
    """
    rng, count = np.random.default_rng(4), 400_000
    spad = SpadParams(divergence_rad=0.02, aperture_radius_m=0.02)
    tilt, spot = math.radians(50.0), np.array([2.0, 0.0, 0.0])
    wall = np.array([-math.cos(tilt), math.sin(tilt), 0.0])
    leg = np.array([-0.5, 0.8, 0.2])
    leg *= 1.5 / np.linalg.norm(leg)
    plate = -leg / 1.5 + np.array([0.3, 0.0, 0.1])
    plate /= np.linalg.norm(plate)
    width = np.cross(plate, [0.0, 0.0, 1.0])
    width /= np.linalg.norm(width)
    height = np.cross(plate, width)
    # the laser's light, evenly over its cone
    radius, turn = 0.01 * np.sqrt(rng.random(count)), rng.uniform(0.0, 2.0 * math.pi, count)
    beam = np.column_stack([np.ones(count), radius * np.cos(turn), radius * np.sin(turn)])
    lit = (spot @ wall / (beam @ wall))[:, None] * beam

    def on_plate(point: np.ndarray) -> np.ndarray:
        off = point - spot - leg
        return (np.abs(off @ width) < 0.02) & (np.abs(off @ height) < 0.02)

    def in_view(point: np.ndarray) -> np.ndarray:
        return np.hypot(point[:, 1], point[:, 2]) < 0.01 * point[:, 0]

    def in_aperture(point: np.ndarray) -> np.ndarray:
        return np.hypot(point[:, 1], point[:, 2]) < 0.02

    def spread(point: np.ndarray) -> np.ndarray:
        return rng.choice(point, count)

    out, landed = exchanged(rng, lit, wall, spot + leg, plate, on_plate)
    back, seen = exchanged(rng, spread(landed), plate, spot, wall, in_view)
    caught, _ = exchanged(rng, spread(seen), wall, np.zeros(3), np.array([1.0, 0.0, 0.0]), in_aperture)
    by_rays = photons_per_pulse(spad) * 0.5**2 * 0.4 * out * back * caught
    cosines = float(wall @ leg) / 1.5, -float(plate @ leg) / 1.5
    assert confocal_photons(spad, 2.0, 0.5, 1.5, *cosines, 0.04**2, 0.4) == pytest.approx(by_rays, rel=0.015)
    assert direct_photons(spad, 2.0, 0.5, math.cos(tilt)) == pytest.approx(
        photons_per_pulse(spad) * 0.5 * caught, rel=0.015
    )


def test_no_distance_gives_more_than_was_sent() -> None:
    """As near as 1 um, whatever the focus: never more than the light that the surfaces leave."""
    spad = SpadParams()
    assert direct_photons(spad, 1e-6, 1.0, 1.0, 0.0) <= photons_per_pulse(spad)
    assert direct_photons(spad, 8.0, 1.0, 1.0, 0.0) == pytest.approx(photons_per_pulse(spad) * 5e-3 / 8.0, rel=1e-6)
    assert confocal_photons(spad, 1e-6, 0.5, 1e-6, 1.0, 1.0, 4.0, 1.0) <= 0.25 * photons_per_pulse(spad)


@pytest.mark.parametrize(
    ("call", "complaint"),
    [
        (lambda: fresnel_power(1.5 - 0.1j, 1.0), "index must be n \\+ jk with n > 0 and k >= 0"),
        (lambda: fresnel_power(0.0, 1.0), "index must be n \\+ jk"),
        (lambda: fresnel_power(math.nan, 1.0), "index must be n \\+ jk"),
        (lambda: fresnel_power(1.5, 1.1), "cos_theta must lie in 0..1"),
        (lambda: optical_reflectance(1.5, 1.0, -1e-6, WAVELENGTH_M), "roughness_m must be finite and not negative"),
        (lambda: diffuse_reflectance(1.5, 1.5, 1.0, 0.0, WAVELENGTH_M), "albedo must lie in 0..1"),
        (lambda: direct_photons(SpadParams(), 0.0, 0.5, 1.0), "range_m must be finite and positive"),
        (lambda: direct_photons(SpadParams(), math.inf, 0.5, 1.0), "range_m must be finite and positive"),
        (lambda: direct_photons(SpadParams(), 1.0, 0.5, -0.1), "cos_incidence must lie in 0..1"),
        (lambda: confocal_photons(SpadParams(), 1.0, 0.5, 0.0, 1, 1, 1, 0.5), "segment_m must be finite and positive"),
        (lambda: confocal_photons(SpadParams(), 1.0, 0.5, 1.0, 1, 1, -1, 0.5), "object_area_m2 must not be negative"),
    ],
)
def test_refusals(call, complaint: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=complaint):
        call()
