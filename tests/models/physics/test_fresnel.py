"""Reflection of walls against textbook limits and the table of derived values."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.fresnel import (
    coherent_power,
    half_space_at,
    half_space_reflection,
    slab_at,
    slab_reflection,
    slab_transmission,
    stack_at,
    stack_reflection,
    stack_transmission,
)
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


def random_stack(seed: int, lossy: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """One to five layers of eps 1.2..9 (loss tangent up to 0.2), 0..20 mm thick."""
    rng = np.random.default_rng([seed, 838])
    count = rng.integers(1, 6)
    real = rng.uniform(1.2, 9.0, count)
    loss = real * rng.uniform(0.0, 0.2, count) if lossy else np.zeros(count)
    return real - 1j * loss, rng.uniform(0.0, 20e-3, count)


@pytest.mark.parametrize("polarisation", ["te", "tm"])
def test_stacks_agree_with_the_tmm_package(polarisation: str) -> None:
    """Layout: 40 random stacks of 1..5 lossy layers, 0..89 deg, 10 GHz. Reference: the transfer matrices of the package
    `tmm` (e^{-iwt}: its answers are the conjugates). Known bias: none, both are exact; tolerance: rounding, 1e-11."""
    tmm = pytest.importorskip("tmm")
    angles = np.radians([0.0, 20.0, 45.0, 67.0, 80.0, 89.0])
    for seed in range(40):
        media, thicknesses = random_stack(seed)
        r = stack_reflection(media, thicknesses, np.cos(angles), WAVELENGTH_M, polarisation)
        t = stack_transmission(media, thicknesses, np.cos(angles), WAVELENGTH_M, polarisation)
        indices = [1.0, *np.sqrt(media.conj()), 1.0]
        depths = [np.inf, *thicknesses, np.inf]
        theirs = [
            tmm.coh_tmm({"te": "s", "tm": "p"}[polarisation], indices, depths, angle, WAVELENGTH_M) for angle in angles
        ]
        np.testing.assert_allclose(r, [np.conj(one["r"]) for one in theirs], rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(t, [np.conj(one["t"]) for one in theirs], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("polarisation", ["te", "tm"])
def test_a_stack_of_one_layer_is_the_slab(polarisation: str) -> None:
    """Same closed form in another order of sums; tolerance: rounding. A lone endless layer is the half-space."""
    cosine = np.linspace(0.0, 1.0, 91)
    for thickness in (0.0, 1e-3, 6e-3, 0.4):
        args = (cosine, WAVELENGTH_M, polarisation)
        slab = (CONCRETE, cosine, thickness, WAVELENGTH_M, polarisation)
        np.testing.assert_allclose(stack_reflection([CONCRETE], [thickness], *args), slab_reflection(*slab), atol=2e-14)
        np.testing.assert_allclose(
            stack_transmission([CONCRETE], [thickness], *args), slab_transmission(*slab), atol=2e-14
        )
    np.testing.assert_array_equal(
        stack_reflection([CONCRETE], [np.inf], cosine, WAVELENGTH_M, polarisation),
        half_space_reflection(CONCRETE, cosine, polarisation),
    )
    assert not stack_transmission([CONCRETE], [np.inf], cosine, WAVELENGTH_M, polarisation).any()


@pytest.mark.parametrize("polarisation", ["te", "tm"])
def test_stacks_keep_energy_and_are_reciprocal(polarisation: str) -> None:
    """|R|^2 + |T|^2 = 1 where lossless, < 1 where lossy; T is the same from both sides. Tolerance: rounding."""
    cosine = np.linspace(0.01, 1.0, 60)
    for seed in range(20):
        media, thicknesses = random_stack(seed, lossy=False)
        r = stack_reflection(media, thicknesses, cosine, WAVELENGTH_M, polarisation)
        t = stack_transmission(media, thicknesses, cosine, WAVELENGTH_M, polarisation)
        np.testing.assert_allclose(np.abs(r) ** 2 + np.abs(t) ** 2, 1.0, atol=1e-12)
        media, thicknesses = random_stack(seed)
        r = stack_reflection(media, thicknesses, cosine, WAVELENGTH_M, polarisation)
        t = stack_transmission(media, thicknesses, cosine, WAVELENGTH_M, polarisation)
        assert (np.abs(r) ** 2 + np.abs(t) ** 2).max() < 1.0
        back = stack_transmission(media[::-1], thicknesses[::-1], cosine, WAVELENGTH_M, polarisation)
        np.testing.assert_allclose(back, t, rtol=1e-10)


def test_cutting_a_layer_in_two_changes_nothing() -> None:
    cosine = np.linspace(0.0, 1.0, 40)
    for polarisation in ("te", "tm"):
        whole = stack_reflection([2.7, CONCRETE], [12e-3, 50e-3], cosine, WAVELENGTH_M, polarisation)
        parts = [5e-3, 7e-3, 0.0, 50e-3]
        cut = stack_reflection([2.7, 2.7, 9.0, CONCRETE], parts, cosine, WAVELENGTH_M, polarisation)
        np.testing.assert_allclose(cut, whole, atol=1e-13)


def test_quarter_wave_coat_hides_the_wall() -> None:
    """Layout: eps 2 of lambda / (4 sqrt 2) on a half-space of eps 4, normal incidence; analytic value R = 0."""
    coat = WAVELENGTH_M / (4.0 * np.sqrt(2.0))
    assert abs(stack_reflection([2.0, 4.0], [coat, np.inf], np.array(1.0), WAVELENGTH_M)) < 1e-15


@pytest.mark.parametrize("polarisation", ["te", "tm"])
def test_double_glazing_resonates(polarisation: str) -> None:
    """Layout: two panes of lossless glass (eps 6.31, 4 mm) a gap d apart, 30 deg. Analytic: the Fabry-Perot sum
    T = t^2 e^{-jkdc} / (1 - r^2 e^{-2jkdc}) of one pane's r and t, of size 1 where 2kdc = 2 arg r + 2 pi m and
    |t|^2 / (1 + |r|^2) half a period away. Tolerance: rounding."""
    cosine, wavenumber = np.cos(np.radians(30.0)), 2.0 * np.pi / WAVELENGTH_M
    pane = (6.31, cosine, 4e-3, WAVELENGTH_M, polarisation)
    r, t = slab_reflection(*pane), slab_transmission(*pane)
    gap = 16e-3
    once = np.exp(-1j * wavenumber * gap * cosine)
    built = stack_transmission([6.31, 1.0, 6.31], [4e-3, gap, 4e-3], cosine, WAVELENGTH_M, polarisation)
    assert built == pytest.approx(t**2 * once / (1.0 - r**2 * once**2), abs=1e-14)
    for order, size in ((2.0, 1.0), (2.5, abs(t) ** 2 / (1.0 + abs(r) ** 2))):
        gap = (np.angle(r) + order * np.pi) / (wavenumber * cosine)
        built = stack_transmission([6.31, 1.0, 6.31], [4e-3, gap, 4e-3], cosine, WAVELENGTH_M, polarisation)
        assert abs(built) == pytest.approx(size, abs=1e-13)


@pytest.mark.parametrize(
    ("media", "thicknesses", "message"),
    [
        ([], [], "at least one layer"),
        ([2.0, 3.0], [0.1], "one thickness for each"),
        ([2.0, 3.0], [np.inf, 0.1], "only the last layer of a stack may be endless"),
        ([2.0, 3.0], [0.1, -0.1], "must not be negative"),
        ([2.0, 3.0 + 0.1j], [0.1, 0.1], "Im <= 0"),
    ],
)
def test_impossible_stacks_are_refused(media: list[complex], thicknesses: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        stack_reflection(media, thicknesses, np.array(1.0), WAVELENGTH_M)


def test_one_compiled_wave_is_one_of_many() -> None:
    """Random media, lossless ones too, films to walls and endless ones, grazing included: 1e-12 of r."""
    rng = np.random.default_rng(6)
    for _ in range(2000):
        count = int(rng.integers(1, 5))
        media = rng.uniform(1.0, 10.0, count) - 1j * 10.0 ** rng.uniform(-6.0, 3.0, count) * rng.integers(0, 2, count)
        depth_m = 10.0 ** rng.uniform(-4.0, 0.0, count)
        if rng.random() < 0.3:
            depth_m[-1] = np.inf
        cosine = float(rng.uniform() if rng.random() < 0.9 else 0.0)
        front = half_space_reflection(media[0], np.array(cosine))
        for is_tm, polarisation in ((False, "te"), (True, "tm")):
            r, kept = half_space_at(media[0], cosine, is_tm)
            np.testing.assert_allclose(r, half_space_reflection(media[0], np.array(cosine), polarisation), rtol=1e-12)
            np.testing.assert_allclose(kept, 1.0 - r**2, atol=1e-12)
        slab = slab_reflection(media[0], np.array(cosine), depth_m[0], WAVELENGTH_M)
        np.testing.assert_allclose(slab_at(media[0], cosine, depth_m[0], WAVELENGTH_M), [slab, front], rtol=1e-12)
        stack = stack_reflection(media, depth_m, np.array(cosine), WAVELENGTH_M)
        np.testing.assert_allclose(
            stack_at(media, depth_m, cosine, WAVELENGTH_M), [stack, front], rtol=1e-12, atol=1e-13
        )
