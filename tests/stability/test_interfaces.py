"""Hard cases of walls: grazing incidence, opaque slabs, metal, vanishing thickness."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.fresnel import (
    coherent_power,
    half_space_reflection,
    slab_reflection,
    slab_transmission,
    stack_reflection,
    stack_transmission,
)
from models.physics.materials import CONSTRUCTIONS, TABLE, permittivity, wall_layers
from models.physics.roughness import coherent_power_miller_brown, diffuse_share

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


@pytest.mark.parametrize("name", sorted(CONSTRUCTIONS))
@pytest.mark.parametrize("polarisation", ["te", "tm"])
def test_constructions_are_finite_to_grazing(name: str, polarisation: str) -> None:
    """0..90 deg with 89.999 and 90 themselves, both bands: finite, passive, and -1 at 90 deg."""
    cosine = np.cos(np.radians([*np.linspace(0.0, 89.9, 300), 89.99, 89.999]))
    cosine = np.append(cosine, 0.0)
    for frequency_hz in (10e9, 77e9):
        media, thicknesses = zip(*wall_layers(name, None, frequency_hz), strict=True)
        r = stack_reflection(media, thicknesses, cosine, 299_792_458.0 / frequency_hz, polarisation)
        t = stack_transmission(media, thicknesses, cosine, 299_792_458.0 / frequency_hz, polarisation)
        assert (np.abs(r) ** 2 + np.abs(t) ** 2).max() <= 1.0 + 1e-12
        assert np.isfinite(r).all()
        assert r[-1] == pytest.approx(-1.0)
        assert t[-1] == 0.0


def test_last_thousandth_of_a_degree_follows_the_limit() -> None:
    """TE near grazing: r = -1 + 2 cos / sqrt(eps - 1) + O(cos^2). At 89.999 deg cos = 1.7e-5, so the next order is
    3e-10 and the half-space must follow to 1e-9: a cancelled eps - sin^2 would not."""
    cosine = np.cos(np.radians(89.999))
    expected = -1.0 + 2.0 * cosine / np.sqrt(CONCRETE - 1.0)
    assert half_space_reflection(CONCRETE, cosine) == pytest.approx(expected, abs=1e-9)


def test_brewster_null_survives_a_stack() -> None:
    """eps = 4 coats a half-space of eps = 4 through a vanishing gap of itself: TM at tan = 2 stays 0 to rounding."""
    cosine = np.array(1.0 / np.sqrt(5.0))
    assert abs(stack_reflection([4.0, 4.0, 4.0], [3e-3, 0.0, np.inf], cosine, WAVELENGTH_M, "tm")) < 1e-15


def test_an_opaque_layer_is_where_the_stack_ends() -> None:
    """A metal sheet of 2 mm (e^-1257 one way) and 50 m of concrete hide all behind: bytes equal to the cut stack."""
    cosine = np.linspace(0.0, 1.0, 50)
    for opaque, thickness in ((METAL, 2e-3), (CONCRETE, 50.0)):
        for polarisation in ("te", "tm"):
            args = (cosine, WAVELENGTH_M, polarisation)
            hidden = stack_reflection([3.0, opaque, 6.0, 2.0], [9e-3, thickness, 5e-3, 0.2], *args)
            np.testing.assert_array_equal(hidden, stack_reflection([3.0, opaque], [9e-3, np.inf], *args))
            assert not stack_transmission([3.0, opaque, 6.0], [9e-3, thickness, 5e-3], *args).any()


def test_metal_behind_a_coat_reflects_what_the_coat_leaves() -> None:
    """PEC limit: a coat of eps 4, d = 1 mm on metal at normal incidence, r = (r1 - p) / (1 - r1 p), p = e^{-4jkd}.

    Known bias: the metal's own 2 / |n| = 4.7e-4 per interface; tolerance 2e-3.
    """
    p = np.exp(-8j * np.pi * 1e-3 / WAVELENGTH_M)
    r = stack_reflection([4.0, METAL], [1e-3, np.inf], np.array(1.0), WAVELENGTH_M)
    assert r == pytest.approx((-1.0 / 3.0 - p) / (1.0 + p / 3.0), abs=2e-3)


@pytest.mark.parametrize("polarisation", ["te", "tm"])
@pytest.mark.parametrize("zero", [0.0, -0.0])
def test_total_reflection_inside_a_stack_decays(polarisation: str, zero: float) -> None:
    """Denser to thinner: eps 4, then eps 0.5 beyond its critical angle (60 > 45 deg). Lossless, so |r| = 1 for a thick
    thin-medium, and transmission falls by e^{-k d sqrt(sin^2 - 0.5)} a layer: 0.5 -> 0.6 m divides it by e^{10.5}."""
    thin = complex(0.5, zero)
    r = stack_reflection([4.0, thin, 4.0], [5e-3, 3.0, 5e-3], np.array(0.5), WAVELENGTH_M, polarisation)
    assert abs(r) == pytest.approx(1.0, abs=1e-14)
    t = [
        abs(stack_transmission([4.0, thin, 4.0], [5e-3, depth, 5e-3], np.array(0.5), WAVELENGTH_M, polarisation))
        for depth in (0.5, 0.6)
    ]
    assert t[1] / t[0] == pytest.approx(np.exp(-2.0 * np.pi / WAVELENGTH_M * 0.1 * 0.5), rel=1e-9)


def test_media_alike_at_grazing_do_not_divide_by_zero() -> None:
    for polarisation in ("te", "tm"):
        assert stack_reflection([1.0, 1.0], [0.1, 0.2], np.array(0.0), WAVELENGTH_M, polarisation) == 0.0
        assert stack_transmission([1.0, 1.0], [0.1, 0.2], np.array(0.0), WAVELENGTH_M, polarisation) == 1.0


def test_very_rough_walls_reflect_nothing_without_a_warning() -> None:
    """20 mm at 77 GHz, normal incidence: g^2 = 4,168, so e^-4168 is 0 in float64; the other law says 1 / (pi g^2)."""
    wavelength_m = 299_792_458.0 / 77e9
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        assert coherent_power(20e-3, 1.0, wavelength_m) == 0.0
        assert diffuse_share(20e-3, 1.0, wavelength_m) == 1.0
        heavy = coherent_power_miller_brown(20e-3, 1.0, wavelength_m)
    g_squared = (4.0 * np.pi * 20e-3 / wavelength_m) ** 2
    assert heavy == pytest.approx(1.0 / (np.pi * g_squared), rel=1e-3)


def test_bessel_factor_written_apart_would_be_nan() -> None:
    """exp(-x) I0(x) at x = 2,084: the two factors are 0 and inf; one scaled function keeps both."""
    from scipy.special import i0

    with np.errstate(all="ignore"):
        naive = np.exp(-2084.0) * i0(2084.0)
    assert np.isnan(naive)
    assert np.isfinite(coherent_power_miller_brown(20e-3, 1.0, 299_792_458.0 / 77e9))
