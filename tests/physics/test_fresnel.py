"""Reflection of walls against textbook limits and the table of derived values."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.fresnel import coherent_power, half_space_reflection, slab_reflection, slab_transmission
from models.physics.materials import permittivity

WAVELENGTH_M = 299_792_458.0 / 10e9
CONCRETE = permittivity("concrete", 10e9)


def level_db(r: np.ndarray) -> np.ndarray:
    return 20.0 * np.log10(np.abs(r))


@pytest.mark.parametrize(
    ("name", "te", "tm"),
    [
        ("concrete", (-8.10, -5.83, -2.86, -1.46), (-11.65, -22.2, -8.21)),
        ("brick", (-9.67, -7.01, -3.46, -1.77), (-14.0, -17.7, -7.28)),
        ("wood", (-15.3, -11.5, -5.84, -3.01), (-22.9, -13.4, -6.19)),
        ("glass", (-7.32, -5.25, -2.57, -1.31), (-10.5, -28.3, -8.95)),
        ("wet_ground", (-4.79, -3.41, -1.66, -0.84), (-6.82, -16.1, -12.7)),
    ],
)
def test_half_space_levels_at_10_ghz(name: str, te: tuple[float, ...], tm: tuple[float, ...]) -> None:
    """Half-space |R|^2 in dB at 0, 45, 70, 80 deg (TE) and 45, 70, 80 deg (TM); printed to 3 figures: 0.06 dB."""
    cosine = np.cos(np.radians([0.0, 45.0, 70.0, 80.0]))
    medium = permittivity(name, 10e9)
    np.testing.assert_allclose(level_db(half_space_reflection(medium, cosine)), te, atol=0.06)
    np.testing.assert_allclose(level_db(half_space_reflection(medium, cosine[1:], "tm")), tm, atol=0.06)


def test_polarisations_have_opposite_sign_at_normal_incidence() -> None:
    """Eq. (13) as printed: Gamma_TM(0) = -Gamma_TE(0)."""
    assert half_space_reflection(CONCRETE, 1.0, "tm") == pytest.approx(-half_space_reflection(CONCRETE, 1.0))


def test_brewster_null_of_a_lossless_wall() -> None:
    """Layout: eps = 4, TM at tan(theta) = 2; analytic value 0; tolerance: rounding."""
    assert abs(half_space_reflection(4.0, 1.0 / np.sqrt(5.0), "tm")) < 1e-15


def test_forty_centimetres_of_concrete_are_opaque() -> None:
    """R = -8.1 dB and T = -81 dB at normal incidence, -87 dB at 45 deg TE (printed to 1 dB)."""
    cosine = np.array([1.0, np.sqrt(0.5)])
    np.testing.assert_allclose(level_db(slab_reflection(CONCRETE, cosine, 0.4, WAVELENGTH_M))[0], -8.1, atol=0.06)
    np.testing.assert_allclose(level_db(slab_transmission(CONCRETE, cosine, 0.4, WAVELENGTH_M)), [-81, -87], atol=0.7)


def test_thin_glass_resonates() -> None:
    """At 45 deg TE, 10 GHz: 6 mm reflects -15.5 dB, 4 and 10 mm -1.9 dB (printed to 0.1 dB)."""
    glass = permittivity("glass", 10e9)
    level = level_db(slab_reflection(glass, np.sqrt(0.5), np.array([4e-3, 6e-3, 10e-3]), WAVELENGTH_M))
    np.testing.assert_allclose(level, [-1.9, -15.5, -1.9], atol=0.15)


def test_lossless_slab_keeps_all_energy() -> None:
    """|R|^2 + |T|^2 = 1 for any thickness and angle of a lossless slab; tolerance: rounding."""
    cosine, thickness = np.meshgrid(np.linspace(0.02, 1.0, 40), np.linspace(1e-3, 0.3, 30))
    for polarisation in ("te", "tm"):
        r = slab_reflection(6.31, cosine, thickness, WAVELENGTH_M, polarisation)
        t = slab_transmission(6.31, cosine, thickness, WAVELENGTH_M, polarisation)
        np.testing.assert_allclose(np.abs(r) ** 2 + np.abs(t) ** 2, 1.0, atol=1e-12)


def test_lossy_slab_never_gives_energy() -> None:
    cosine, thickness = np.meshgrid(np.linspace(0.0, 1.0, 40), np.linspace(0.0, 0.3, 30))
    r = slab_reflection(CONCRETE, cosine, thickness, WAVELENGTH_M)
    t = slab_transmission(CONCRETE, cosine, thickness, WAVELENGTH_M)
    assert (np.abs(r) ** 2 + np.abs(t) ** 2).max() <= 1.0 + 1e-12


@pytest.mark.parametrize(
    ("roughness_mm", "loss_db"),
    [(0.5, (-0.19, -0.10, -0.02)), (1.0, (-0.76, -0.38, -0.09)), (2.0, (-3.1, -1.5, -0.36))],
)
def test_roughness_takes_power_from_the_mirror(roughness_mm: float, loss_db: tuple[float, ...]) -> None:
    """Power factor in dB at 0, 45, 70 deg, 10 GHz (printed to 2 figures: 0.05 dB)."""
    cosine = np.cos(np.radians([0.0, 45.0, 70.0]))
    np.testing.assert_allclose(
        10.0 * np.log10(coherent_power(1e-3 * roughness_mm, cosine, WAVELENGTH_M)), loss_db, atol=0.051
    )


def test_active_media_and_impossible_angles_are_refused() -> None:
    with pytest.raises(ValueError, match="Im <= 0"):
        half_space_reflection(2.0 + 0.1j, 1.0)
    with pytest.raises(ValueError, match=r"cos_theta must lie in 0\.\.1"):
        half_space_reflection(2.0, 1.2)
    with pytest.raises(ValueError, match="thickness_m must not be negative"):
        slab_reflection(2.0, 1.0, -1e-3, WAVELENGTH_M)
