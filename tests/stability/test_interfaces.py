"""Hard cases of walls: grazing incidence, opaque slabs, metal, vanishing thickness."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.fresnel import half_space_reflection, slab_reflection, slab_transmission
from models.physics.materials import TABLE, permittivity

WAVELENGTH_M = 299_792_458.0 / 10e9
METAL = permittivity("metal", 10e9)
CONCRETE = permittivity("concrete", 10e9)


@pytest.mark.parametrize("polarisation", ["te", "tm"])
@pytest.mark.parametrize("medium", [1.5, 4.0, CONCRETE, METAL])
def test_everything_mirrors_at_grazing(medium: complex, polarisation: str) -> None:
    """R -> -1 at 90 deg, both polarisations (metal in TM only beyond its pseudo-Brewster angle, so at 90 itself)."""
    assert half_space_reflection(medium, 0.0, polarisation) == pytest.approx(-1.0)


@pytest.mark.parametrize("name", sorted(TABLE))
def test_sweep_to_the_last_tenth_of_a_degree_is_finite(name: str) -> None:
    cosine = np.cos(np.radians(np.linspace(0.0, 90.0, 901)))
    medium = permittivity(name, 10e9, extrapolate=True)
    for polarisation in ("te", "tm"):
        for r in (
            half_space_reflection(medium, cosine, polarisation),
            slab_reflection(medium, cosine, 0.2, WAVELENGTH_M, polarisation),
            slab_transmission(medium, cosine, 0.2, WAVELENGTH_M, polarisation),
        ):
            assert np.isfinite(r).all()
            assert np.abs(r).max() <= 1.0 + 1e-12


def test_opaque_slab_equals_half_space_without_overflow() -> None:
    """A metal plate of 1 m: the growing exponential is e^{+4e6}; ours is exactly the half-space."""
    with np.errstate(over="ignore"):
        growing = np.exp(2.0 * 2.0 * np.pi / WAVELENGTH_M * np.abs(np.sqrt(METAL).imag))
    assert np.isinf(growing)
    assert slab_reflection(METAL, 0.6, 1.0, WAVELENGTH_M) == half_space_reflection(METAL, 0.6)
    assert slab_transmission(METAL, 0.6, 1.0, WAVELENGTH_M) == 0.0
    np.testing.assert_array_equal(
        slab_reflection(CONCRETE, 0.6, np.array([50.0, np.inf]), WAVELENGTH_M), half_space_reflection(CONCRETE, 0.6)
    )


def test_slab_without_thickness_is_not_there() -> None:
    assert slab_reflection(CONCRETE, 0.3, 0.0, WAVELENGTH_M) == 0.0
    assert slab_transmission(CONCRETE, 0.3, 0.0, WAVELENGTH_M) == pytest.approx(1.0, abs=1e-15)


def test_thin_slab_goes_to_zero_linearly() -> None:
    """r ~ j k d (eps - 1) / (2 cos) in size as d -> 0 (TE, normal incidence); the next order is k d |n| ~ 1e-4."""
    thickness = 1e-7
    expected = np.pi / WAVELENGTH_M * thickness * abs(CONCRETE - 1.0)
    assert abs(slab_reflection(CONCRETE, 1.0, thickness, WAVELENGTH_M)) == pytest.approx(expected, rel=1e-3)


def test_metal_is_a_perfect_mirror() -> None:
    """PEC limit: |1 + r| = 2 / |n|, 4.7e-4 at 10 GHz and normal incidence."""
    assert abs(half_space_reflection(METAL, 1.0) + 1.0) == pytest.approx(2.0 / abs(np.sqrt(METAL)), rel=1e-3)


def test_empty_space_reflects_nothing_even_at_grazing() -> None:
    np.testing.assert_array_equal(half_space_reflection(1.0, np.array([0.0, 1e-9, 1.0])), 0.0)


def test_branch_decays_for_media_with_negative_zero_loss() -> None:
    """Lossless media written with +0j and -0j must reflect alike, below and beyond the critical angle of eps < 1."""
    cosine = np.linspace(0.0, 1.0, 101)
    for real in (0.5, 4.0):
        np.testing.assert_array_equal(
            half_space_reflection(complex(real, 0.0), cosine), half_space_reflection(complex(real, -0.0), cosine)
        )
    inside = slab_transmission(complex(0.5, 0.0), 0.2, 1.0, WAVELENGTH_M)
    assert abs(inside) < 1e-10
