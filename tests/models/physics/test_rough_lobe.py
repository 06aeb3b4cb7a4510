"""Diffuse lobe of a rough wall: its energy, its symmetry, and the limits of small heights and of many orders."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import poisson

from models.physics.fresnel import diffuse_share
from models.physics.rough_lobe import RoughLobe, mean_over_orders, rough_lobe

WAVELENGTH_M = 0.03
WALLS = [(2e-3, 0.03), (4e-3, 0.03), (4e-3, 0.01), (1e-3, 0.005), (2e-3, 0.1), (0.03, 0.03)]


def radiated(lobe: RoughLobe, cosine: float, nodes: int = 400) -> float:
    """Power per area that leaves over what falls on it: an independent midpoint rule about the wall's normal."""
    polar = (np.arange(nodes) + 0.5) / nodes * 0.5 * math.pi
    azimuth = (np.arange(nodes) + 0.5) / nodes * math.pi
    theta, phi = np.meshgrid(polar, azimuth, indexing="ij")
    along = np.hypot(math.sqrt(1.0 - cosine**2) + np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi))
    power = lobe.bistatic(np.full(theta.shape, cosine), np.cos(theta), along) * np.sin(theta)
    return float(power.sum() * (0.5 * math.pi / nodes) * (2.0 * math.pi / nodes) / (4.0 * math.pi))


@pytest.mark.parametrize(("roughness_m", "correlation_m"), WALLS)
@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 60.0, 75.0])
def test_lobe_radiates_what_roughness_takes(roughness_m: float, correlation_m: float, angle_deg: float) -> None:
    """Analytic: (1 - rho) cos of the incidence. Tolerance 1 %: the table of the normalisation over cosines."""
    cosine = math.cos(math.radians(angle_deg))
    lobe = RoughLobe(roughness_m, correlation_m, WAVELENGTH_M)
    taken = float(diffuse_share(np.asarray(roughness_m), np.asarray(cosine), WAVELENGTH_M)) * cosine
    assert radiated(lobe, cosine, 160) == pytest.approx(taken, rel=1e-2)


def test_lobe_is_reciprocal() -> None:
    """Exact: source and observer change places."""
    rng = np.random.default_rng(3)
    cos_in, cos_out, along = rng.uniform(0.0, 1.0, (2, 200)), rng.uniform(0.0, 1.0, (2, 200)), rng.uniform(0, 1.9, 200)
    lobe = RoughLobe(3e-3, 0.02, WAVELENGTH_M)
    np.testing.assert_array_equal(
        lobe.bistatic(cos_in[0], cos_out[0], along), lobe.bistatic(cos_out[0], cos_in[0], along)
    )


def test_back_to_the_radar_is_the_lobe_towards_it() -> None:
    """Both directions the same: |u_i + u_s| is twice the sine; 1e-12."""
    cosine = np.linspace(0.02, 1.0, 50)
    lobe = RoughLobe(2e-3, 0.02, WAVELENGTH_M)
    there = lobe.bistatic(cosine, cosine, 2.0 * np.sqrt(1.0 - cosine**2))
    np.testing.assert_allclose(lobe.backscatter(cosine), there, rtol=1e-12)


def test_small_heights_scatter_as_perturbation_theory() -> None:
    """Bragg, backscatter near the normal: 4 k^4 s^2 l^2 exp(-k^2 l^2 sin^2), s = 3e-6 wavelengths.

    Tolerance 1 %: the factor of tangent planes is 1 / cos^2 of the field's here, and the normalisation lies by 1.
    """
    roughness_m, correlation_m, wave = 1e-7, 0.15, 2.0 * math.pi / WAVELENGTH_M
    sine = np.sin(np.radians([0.0, 1.0, 2.0, 4.0]))
    bragg = 4.0 * wave**4 * (roughness_m * correlation_m) ** 2 * np.exp(-((wave * correlation_m * sine) ** 2))
    lobe = RoughLobe(roughness_m, correlation_m, WAVELENGTH_M)
    np.testing.assert_allclose(lobe.backscatter(np.sqrt(1.0 - sine**2)), bragg, rtol=1e-2)


@pytest.mark.parametrize("roughness_m", [0.1, 1.0, 100.0])
def test_large_heights_are_facets(roughness_m: float) -> None:
    """Geometric optics: exp(-tan^2 / 2 m^2) / (2 m^2 cos^4), m the rms slope 0.14, whatever the heights.

    Tolerance 3 %: orders spread by 1 / (2 k s), the normalisation by m^2.
    """
    slope = 0.14
    lobe = RoughLobe(roughness_m, math.sqrt(2.0) * roughness_m / slope, WAVELENGTH_M)
    cosine = np.cos(np.radians([0.0, 5.0, 10.0, 15.0]))
    tangent = np.sqrt(1.0 - cosine**2) / cosine
    facets = np.exp(-0.5 * (tangent / slope) ** 2) / (2.0 * slope**2 * cosine**4)
    np.testing.assert_allclose(lobe.backscatter(cosine), facets, rtol=3e-2)


def test_lit_elevations_are_averaged() -> None:
    """Against a mean over tilted directions of the same lobe: 1 % for +-0.15 rad (its change of g and of facets)."""
    lobe = RoughLobe(2e-3, 0.06, WAVELENGTH_M)
    cosine = np.cos(np.radians([0.0, 10.0, 20.0]))
    elevation = (np.arange(200) + 0.5) / 200.0 * 0.15
    tilted = np.mean([lobe.backscatter(cosine * math.cos(e)) for e in elevation], axis=0)
    np.testing.assert_allclose(lobe.backscatter(cosine, 0.15), tilted, rtol=3e-2)
    assert np.all(lobe.backscatter(cosine, 0.15) < 0.8 * lobe.backscatter(cosine))


@pytest.mark.parametrize("mean", [1e-6, 0.3, 2.0, 15.0, 40.0, 300.0, 2e4])
def test_orders_are_those_of_poisson(mean: float) -> None:
    """The mean of 1 / m over whole orders; 1e-6 where they are taken in steps."""
    every = np.arange(1, int(mean + 12.0 * math.sqrt(mean) + 40.0))
    exact = np.sum(poisson.pmf(every, mean) / every)
    assert mean_over_orders(mean, 1.0, 0.0, 0.0) == pytest.approx(exact, rel=1e-6, abs=0.0)


def test_one_wall_has_one_lobe() -> None:
    assert rough_lobe(1e-3, 0.03, WAVELENGTH_M) is rough_lobe(1e-3, 0.03, WAVELENGTH_M)


@pytest.mark.parametrize("bad", [0.0, -1e-3, math.nan, math.inf])
@pytest.mark.parametrize("name", ["roughness_m", "correlation_m", "wavelength_m"])
def test_bad_walls_are_refused(name: str, bad: float) -> None:
    given: dict[str, Any] = {"roughness_m": 1e-3, "correlation_m": 0.03, "wavelength_m": 0.03, name: bad}
    with pytest.raises(ValueError, match=f"{name} must be finite and positive, got {bad!r}"):
        RoughLobe(**given)
