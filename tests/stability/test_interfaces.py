"""Hard cases of walls: grazing incidence, opaque slabs, metal, vanishing thickness, total reflection, roughness."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import mpmath
import numpy as np
import pytest
from mpmath import mp

from models.physics.fresnel import (
    Polarisation,
    coherent_power,
    diffuse_share,
    half_space_reflection,
    slab_reflection,
    slab_transmission,
    stack_reflection,
    stack_transmission,
)
from models.physics.materials import CONSTRUCTIONS, permittivity, wall_layers
from tests.stability.catalogue import Errors

POLARISATIONS: tuple[Polarisation, ...] = ("te", "tm")
WAVELENGTH_M = 299_792_458.0 / 10e9
WAVELENGTH_77_M = 299_792_458.0 / 77e9
METAL = permittivity("metal", 10e9)
CONCRETE = permittivity("concrete", 10e9)


def characteristic(
    media: list[complex], thicknesses_m: list[float], cosine: Any, polarisation: Polarisation, lib: ModuleType | Any
) -> tuple[Any, Any, Any]:
    """Textbook product of characteristic matrices in air: reflection, transmission, and the latter the other way.

    cos and j sin of every layer's phase hold both the wave that decays and the one that grows. `lib`: numpy for the
    naive form, mpmath with as many digits as are lost for the reference. Backwards it is det(M) times forwards.
    """
    one = mpmath.mpf(1) if lib is mp else 1.0
    m = [[one, 0 * one], [0 * one, one]]
    for medium, thickness_m in zip(media, thicknesses_m, strict=True):
        q = lib.sqrt(lib.mpmathify(medium) - 1 + cosine**2 if lib is mp else np.complex128(medium) - 1 + cosine**2)
        admittance = q if polarisation == "te" else q / medium
        phase = 2 * (mp.pi if lib is mp else np.pi) / WAVELENGTH_M * q * thickness_m
        c, s = lib.cos(phase), 1j * lib.sin(phase)
        layer = [[c, s / admittance], [admittance * s, c]]
        m = [[sum(m[i][k] * layer[k][j] for k in range(2)) for j in range(2)] for i in range(2)]
    (b, c), (d, e) = m
    front, back = b + c * cosine, d + e * cosine
    down = cosine * front + back
    det = b * e - c * d
    return (cosine * front - back) / down, 2 * cosine / down, 2 * cosine * det / down


def exactly(
    media: list[complex], thicknesses_m: list[float], cosine: float, polarisation: Polarisation
) -> list[complex]:
    """`characteristic` in 1,000 digits."""
    with mp.workdps(1000):
        return [complex(value) for value in characteristic(media, thicknesses_m, mp.mpf(cosine), polarisation, mp)]


def naively(
    media: list[complex], thicknesses_m: list[float], cosine: float, polarisation: Polarisation
) -> list[complex]:
    """`characteristic` in float64."""
    with np.errstate(all="ignore"):
        return [complex(value) for value in characteristic(media, thicknesses_m, cosine, polarisation, np)]


def exact_half_space(medium: complex, cosine: float, polarisation: Polarisation) -> complex:
    """Eq. (13) in 50 digits, on the branch that decays."""
    with mp.workdps(50):
        q = mp.sqrt(mp.mpmathify(medium) - 1 + mp.mpf(cosine) ** 2)
        q = -q if mp.im(q) > 0 else q
        outer = mp.mpf(cosine) if polarisation == "te" else mp.mpmathify(medium) * mp.mpf(cosine)
        return complex((outer - q) / (outer + q))


@pytest.mark.hard("models.physics.fresnel", "characteristic matrix, cos and sin of a complex phase", 2e-15, "",
                  "the half-space as limit; rounding of four factors")  # fmt: skip
def test_opaque_slab_is_a_half_space(errors: Errors) -> None:
    """A metal plate of 1 m and 50 m of concrete: the wave that grows on the way back is e^{+6e5} and e^{+1227}."""
    naive, ours = [], []
    for medium, thickness_m in ((METAL, 1.0), (CONCRETE, 50.0), (CONCRETE, np.inf)):
        for polarisation in POLARISATIONS:
            exact = exact_half_space(medium, 0.6, polarisation)
            naive.append(naively([medium], [thickness_m], 0.6, polarisation)[0] - exact)
            ours.append(slab_reflection(medium, 0.6, thickness_m, WAVELENGTH_M, polarisation) - exact)
    assert slab_transmission(METAL, 0.6, 1.0, WAVELENGTH_M) == 0.0
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "characteristic matrices multiplied", 4e-15, "",
                  "rounding of four interfaces in float64")  # fmt: skip
def test_opaque_sheet_in_a_stack(errors: Errors) -> None:
    """Plaster, 2 mm of metal, concrete: infinity times nothing inside the product; what is behind must not matter."""
    media, thicknesses = [3.0, METAL, CONCRETE], [9e-3, 2e-3, 0.2]
    naive, ours = [], []
    for cosine in (1e-3, 0.3, 1.0):
        for polarisation in POLARISATIONS:
            exact = exactly(media, thicknesses, cosine, polarisation)[0]
            naive.append(naively(media, thicknesses, cosine, polarisation)[0] - exact)
            ours.append(stack_reflection(media, thicknesses, np.array(cosine), WAVELENGTH_M, polarisation) - exact)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "backward transmission as det(M) / M of the characteristic matrix", 2e-13,
                  "relative",
                  "three roundings (1e-16 each) of the phases k q d, 340 rad, and of ten factors")  # fmt: skip
def test_a_lossy_stack_is_reciprocal(errors: Errors) -> None:
    """Two wet walls and an air gap let e^-54 through, the same both ways; det(M) = 1 is a difference of e^+108."""
    media, thicknesses = [12.0 - 4.0j, 1.0, 7.0 - 2.0j], [0.3, 0.1, 0.2]
    naive, ours = [], []
    for polarisation in POLARISATIONS:
        exact = exactly(media, thicknesses, 0.7, polarisation)[1]
        naive.append(naively(media, thicknesses, 0.7, polarisation)[2] / exact - 1.0)
        for way in (1, -1):
            t = stack_transmission(media[::way], thicknesses[::way], np.array(0.7), WAVELENGTH_M, polarisation)
            ours.append(t / exact - 1.0)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "characteristic matrices multiplied", 4e-15, "",
                  "energy: |r|^2 + |t|^2 = 1 without losses; rounding of four interfaces")  # fmt: skip
def test_energy_in_total_reflection_inside_a_stack(errors: Errors) -> None:
    """Denser to thinner: eps 4, then 0.01 to 10 m of eps 0.5 at 60 deg, where all is evanescent: e^{+1048}."""
    naive, ours = [], []
    for polarisation in POLARISATIONS:
        for thin in (complex(0.5, 0.0), complex(0.5, -0.0)):
            for depth_m in (0.01, 10.0):
                stack = [4.0, thin, 4.0], [5e-3, depth_m, 5e-3]
                r, t, _ = naively(*stack, 0.5, polarisation)
                naive.append(abs(r) ** 2 + abs(t) ** 2 - 1.0)
                r = stack_reflection(*stack, np.array(0.5), WAVELENGTH_M, polarisation)
                t = stack_transmission(*stack, np.array(0.5), WAVELENGTH_M, polarisation)
                ours.append(abs(r) ** 2 + abs(t) ** 2 - 1.0)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "principal square root of eps - sin^2", 1e-15, "", "rounding of Eq. (13)")
def test_branch_of_total_reflection(errors: Errors) -> None:
    """Denser to thinner, lossless: the principal root has Im > 0, a wave that grows; |r| = 1 hides the wrong phase."""
    naive, ours = [], []
    for medium in (complex(0.5, 0.0), complex(0.5, -0.0)):
        for cosine in (0.05, 0.3, 0.7):
            exact = exact_half_space(medium, cosine, "te")
            q = np.sqrt(np.complex128(medium) - (1.0 - cosine**2))
            naive.append((cosine - q) / (cosine + q) - exact)
            ours.append(half_space_reflection(medium, cosine) - exact)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "sin(a - b) / sin(a + b) and tan(a - b) / tan(a + b)", 1e-15, "",
                  "rounding of Eq. (13)")  # fmt: skip
def test_normal_incidence(errors: Errors) -> None:
    """Fresnel's laws in angles are 0 / 0 for the ray that matters most, straight on."""
    outside, inside = 0.0, np.arcsin(0.0 / 2.0)
    with np.errstate(invalid="ignore"):
        te = -np.sin(outside - inside) / np.float64(np.sin(outside + inside))
        tm = np.tan(outside - inside) / np.float64(np.tan(outside + inside))
    ours = [half_space_reflection(4.0, 1.0, "te") + 1.0 / 3.0, half_space_reflection(4.0, 1.0, "tm") - 1.0 / 3.0]
    errors(naive=np.abs([te + 1.0 / 3.0, tm - 1.0 / 3.0]).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "eps - sin^2 written out", 2e-15, "", "rounding of Eq. (13)")
def test_hot_air_at_89_999_deg(errors: Errors) -> None:
    """Air over hot ground, eps - 1 = +-1e-8, mirrors at grazing alone: eps and sin^2 agree in eight digits."""
    angle = np.radians(89.999)
    cosine = np.cos(angle)
    naive, ours = [], []
    for medium in (1.0 + 1e-8, 1.0 - 1e-8):
        exact = exact_half_space(medium, cosine, "te")
        q = np.sqrt(np.complex128(medium) - np.sin(angle) ** 2)
        q = -q if q.imag > 0.0 else q
        naive.append((cosine - q) / (cosine + q) - exact)
        ours.append(half_space_reflection(medium, cosine) - exact)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "cosine of incidence from the sine", 2e-15, "", "rounding of Eq. (13)")
def test_metal_at_its_pseudo_brewster_angle(errors: Errors) -> None:
    """TM on metal turns from +1 to -1 within a minute of arc of grazing, at cos = 1 / |n| = 2.4e-4."""
    cosine = float(1.0 / np.abs(np.sqrt(METAL)))
    sine = np.sin(np.arccos(cosine))
    exact = exact_half_space(METAL, cosine, "tm")
    naive = half_space_reflection(METAL, np.sqrt(1.0 - sine**2), "tm")
    errors(naive=abs(naive - exact), ours=abs(half_space_reflection(METAL, cosine, "tm") - exact))


def single(medium: complex, cosine: float, polarisation: Polarisation) -> np.complex64:
    """Eq. (13) in complex64."""
    eps, cos = np.complex64(medium), np.float32(cosine)
    q = np.sqrt(eps - np.float32(1.0) + cos * cos)
    outer = cos if polarisation == "te" else eps * cos
    return np.complex64((outer - q) / (outer + q))


@pytest.mark.hard("models.physics.fresnel", "Eq. (13) in complex64", 1e-15, "", "rounding of Eq. (13)")
def test_brewster_null(errors: Errors) -> None:
    """Lossless walls of eps 2 to 80, TM at tan = n: nothing comes back but rounding."""
    media = np.linspace(2.0, 80.0, 40)
    cosine = 1.0 / np.sqrt(1.0 + media)
    ours = half_space_reflection(media, cosine, "tm")
    naive = [single(medium, cos, "tm") for medium, cos in zip(media, cosine, strict=True)]
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "1 + r of Eq. (13) in complex64", 2e-12, "relative",
                  "four roundings of r near -1, over |1 + r| = 2 / |n| = 4.7e-4")  # fmt: skip
def test_what_metal_takes(errors: Errors) -> None:
    """Metal limit: all that tells a metal from a perfect one is 1 + r = 2 / n, lost beside -1 in single precision."""
    naive, ours = [], []
    for medium in (METAL, permittivity("metal", 77e9, extrapolate=True)):
        exact = 1.0 / complex(exact_excess(medium))
        naive.append((1.0 + complex(single(medium, 1.0, "te"))) * exact - 1.0)
        ours.append((1.0 + half_space_reflection(medium, 1.0)) * exact - 1.0)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


def exact_excess(medium: complex) -> complex:
    """1 + r = 2 / (1 + n) at normal incidence, TE, in 50 digits."""
    with mp.workdps(50):
        return complex(2 / (1 + mp.sqrt(mp.mpmathify(medium))))


@pytest.mark.hard("models.physics.fresnel", "r (1 - p) / (1 - r^2 p) with p = exp(-2j k q d)", 1e-14, "relative",
                  "rounding of ten factors in float64")  # fmt: skip
def test_a_film_of_one_molecule(errors: Errors) -> None:
    """0.3 nm in air, straight on and at 89.999 deg: what it returns, 1e-7 of the field, is what 1 - p has left."""
    medium = CONCRETE
    naive, ours = [], []
    for thickness_m in (3e-10, 1e-6, 1e-4):
        for cosine in (1.0, 0.3, float(np.cos(np.radians(89.999)))):
            exact = exactly([medium], [thickness_m], cosine, "te")[0]
            r = half_space_reflection(medium, cosine)
            p = np.exp(-4j * np.pi / WAVELENGTH_M * np.sqrt(medium - 1.0 + cosine**2) * thickness_m)
            naive.append(r * (1.0 - p) / (1.0 - r**2 * p) / exact - 1.0)
            ours.append(slab_reflection(medium, cosine, thickness_m, WAVELENGTH_M) / exact - 1.0)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.fresnel", "1 - r^2 subtracted", 1e-14, "relative",
                  "rounding of ten factors in float64")  # fmt: skip
def test_through_a_metal_coat_at_89_999_deg(errors: Errors) -> None:
    """10 nm of metal on a pane: r is within 1e-8 of -1, and what enters is 1 - r^2."""
    cosine, thickness_m = float(np.cos(np.radians(89.999))), 1e-8
    exact = exactly([METAL], [thickness_m], cosine, "te")[1]
    r = half_space_reflection(METAL, cosine)
    once = np.exp(-2j * np.pi / WAVELENGTH_M * np.sqrt(METAL - 1.0 + cosine**2) * thickness_m)
    naive = (1.0 - r**2) * once / (1.0 - (r * once) ** 2)
    ours = slab_transmission(METAL, cosine, thickness_m, WAVELENGTH_M)
    errors(naive=abs(naive / exact - 1.0), ours=abs(ours / exact - 1.0))


@pytest.mark.hard("models.physics.fresnel", "the first 100 inner bounces added up", 7e-11, "",
                  "four roundings (1e-16 each) of the phase 2 k q d = 2 pi, over 1 - r^2 = 4e-5")  # fmt: skip
def test_resonance_at_grazing(errors: Errors) -> None:
    """A half-wave pane at 89.999 deg is clear while all around it mirrors: 2.5e4 bounces inside make it so."""
    cosine = float(np.cos(np.radians(89.999)))
    q = np.sqrt(3.0 + cosine**2)
    naive, ours = [], []
    for detuning in (0.0, 1e-6, -1e-5):
        thickness_m = float(0.5 * WAVELENGTH_M / q * (1.0 + detuning))
        exact = exactly([4.0], [thickness_m], cosine, "te")[0]
        r = half_space_reflection(4.0, cosine)
        p = np.exp(-4j * np.pi / WAVELENGTH_M * q * thickness_m)
        bounces = sum((r**2 * p) ** n for n in range(100))
        naive.append(r - (1.0 - r**2) * r * p * bounces - exact)
        ours.append(slab_reflection(4.0, cosine, thickness_m, WAVELENGTH_M) - exact)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


def test_empty_space_reflects_nothing_even_at_grazing() -> None:
    np.testing.assert_array_equal(half_space_reflection(1.0, np.array([0.0, 1e-9, 1.0])), 0.0)


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


def test_media_alike_at_grazing_do_not_divide_by_zero() -> None:
    for polarisation in ("te", "tm"):
        assert stack_reflection([1.0, 1.0], [0.1, 0.2], np.array(0.0), WAVELENGTH_M, polarisation) == 0.0
        assert stack_transmission([1.0, 1.0], [0.1, 0.2], np.array(0.0), WAVELENGTH_M, polarisation) == 1.0


def test_very_rough_walls_reflect_nothing_without_a_warning() -> None:
    """20 mm at 77 GHz, normal incidence: g^2 = 4,168, so e^-4168 is 0 in float64."""
    wavelength_m = 299_792_458.0 / 77e9
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        assert coherent_power(20e-3, 1.0, wavelength_m) == 0.0
        assert diffuse_share(20e-3, 1.0, wavelength_m) == 1.0


@pytest.mark.hard("models.physics.fresnel", "1 - exp(-g^2)", 2e-15, "relative", "rounding of g^2")
def test_what_a_smooth_wall_scatters(errors: Errors) -> None:
    """0.1 to 10 um of glass, upright and at 89.999 deg: exp(-g^2) rounds to one and nothing would be diffuse."""
    naive, ours = [], []
    for roughness_m in (1e-7, 1e-6, 1e-5):
        for cosine in (1.0, float(np.cos(np.radians(89.999)))):
            with mp.workdps(50):
                g = 4 * mp.pi * mp.mpf(roughness_m) * mp.mpf(cosine) / mp.mpf(WAVELENGTH_77_M)
                exact = float(-mp.expm1(-(g**2)))
            naive.append((1.0 - coherent_power(roughness_m, cosine, WAVELENGTH_77_M)) / exact - 1.0)
            ours.append(diffuse_share(roughness_m, cosine, WAVELENGTH_77_M) / exact - 1.0)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())
