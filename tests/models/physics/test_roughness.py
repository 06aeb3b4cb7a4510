"""Laws of roughness against their limits, their definitions as averages over heights, and the criteria."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.fresnel import coherent_power, diffuse_share

WAVELENGTH_M = 299_792_458.0 / 10e9


def roughness_of(phase_rad: float) -> float:
    return phase_rad * WAVELENGTH_M / (4.0 * np.pi)


@pytest.mark.parametrize("phase_rad", [0.1, 0.5, 1.0, 2.0])
def test_gaussian_law_is_the_mean_phasor_of_gaussian_heights(phase_rad: float) -> None:
    """|<e^{jgz}>|^2 over a standard normal z, by quadrature (Gauss-Hermite, 60 points: exact to rounding here)."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    mean = np.sum(weights * np.exp(1j * phase_rad * nodes)) / np.sqrt(2.0 * np.pi)
    assert coherent_power(roughness_of(phase_rad), 1.0, WAVELENGTH_M) == pytest.approx(abs(mean) ** 2, rel=1e-9)


def test_a_quarter_of_a_right_angle_costs_the_mirror_little() -> None:
    """g = pi / 8 at lambda / 32."""
    loss_db = 10.0 * np.log10(coherent_power(WAVELENGTH_M / 32.0, 1.0, WAVELENGTH_M))
    assert loss_db == pytest.approx(-0.67, abs=0.005)


def test_coherent_and_diffuse_share_the_power() -> None:
    """They sum to one, and a nearly smooth wall's diffuse share is g^2 = 1e-16 and not the 0 of 1 - exp(-g^2)."""
    heights = np.linspace(0.0, 10e-3, 50)
    total = coherent_power(heights, 0.7, WAVELENGTH_M) + diffuse_share(heights, 0.7, WAVELENGTH_M)
    np.testing.assert_allclose(total, 1.0, atol=1e-15)
    assert diffuse_share(roughness_of(1e-8), 1.0, WAVELENGTH_M) == pytest.approx(1e-16, rel=1e-9, abs=0.0)


@pytest.mark.parametrize("roughness_m", [-1e-3, np.nan, np.inf])
def test_impossible_walls_are_refused(roughness_m: float) -> None:
    with pytest.raises(ValueError, match="roughness_m must be finite and not negative"):
        diffuse_share(roughness_m, 1.0, WAVELENGTH_M)
    with pytest.raises(ValueError, match=r"cos_theta must lie in 0\.\.1"):
        diffuse_share(1e-3, 1.5, WAVELENGTH_M)
