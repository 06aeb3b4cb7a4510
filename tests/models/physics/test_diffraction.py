"""Uniform theory of diffraction against Fresnel integrals, exact half planes and wedges, and the surface integral."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import fresnel, jv, wofz

from models.physics.diffraction import passed_share_at, scaled_erfc, wedge_terms_at
from tests.models.physics.surface_integral import wall_field

WAVELENGTH_M = 0.03
K = 2.0 * np.pi / WAVELENGTH_M
wedge_terms = np.vectorize(wedge_terms_at, otypes=[complex] * 3)


def edge_field(coefficient: np.ndarray, source_m: np.ndarray, target_m: np.ndarray) -> np.ndarray:
    return np.asarray(coefficient * np.sqrt((source_m + target_m) / (source_m * target_m)))


def coefficient(
    n: float, source: np.ndarray, target: np.ndarray, distance_m: np.ndarray, r: complex = -1.0
) -> np.ndarray:
    arrays = (np.asarray(value, np.float64) for value in (n, source, target, distance_m))
    incident, first, last = wedge_terms(*arrays, WAVELENGTH_M, 1.0)
    return np.asarray(incident + r * (first + last))


@pytest.mark.parametrize("part", ["incident", "reflected"])
def test_half_plane_in_a_plane_wave_is_exact(part: str) -> None:
    """n = 2, source far away: the uniform field is Sommerfeld's, at any distance; rounding.

    e^{j k rho cos b} e^{j pi/4} / sqrt(pi) int_{-sqrt(2 k rho) cos(b/2)}^inf e^{-jt^2} dt, b the difference (incident)
    or the sum (reflected) of both angles.
    """
    rho, source = 0.4, 0.9
    target = np.linspace(0.05, 2.0 * np.pi - 0.05, 331)
    terms = wedge_terms(np.array(2.0), np.array(source), target, np.array(rho), WAVELENGTH_M, 1.0)
    b = target - source if part == "incident" else target + source
    sine, cosine = fresnel(-np.sqrt(2.0 * K * rho) * np.cos(0.5 * b) * np.sqrt(2.0 / np.pi))
    integral = np.sqrt(0.5 * np.pi) * ((0.5 - cosine) - 1j * (0.5 - sine))
    wave = np.exp(1j * K * rho * np.cos(b))
    exact = wave * np.exp(0.25j * np.pi) / np.sqrt(np.pi) * integral
    bent = (terms[0] if part == "incident" else terms[1] + terms[2]) * np.exp(-1j * K * rho) / np.sqrt(rho)
    np.testing.assert_allclose((np.cos(0.5 * b) > 0.0) * wave + bent, exact, atol=1e-9)


@pytest.mark.parametrize("rho", [0.2, 0.4])
def test_metal_house_corner_against_the_exact_series(rho: float) -> None:
    """n = 3/2, soft, plane wave: (4/n) sum j^{m/n} J_{m/n}(k rho) sin(m f'/n) sin(m f/n).

    Bias: the uniform theory is the first term over k rho; tolerance 0.3 / (k rho)^1.5 ~ what the next leaves.
    """
    n, source = 1.5, 1.1
    target = np.linspace(0.02, n * np.pi - 0.02, 240)
    m = np.arange(1, int(n * (K * rho + 60.0)))[:, None]
    series = (
        (4.0 / n) * np.exp(0.5j * np.pi * m / n) * jv(m / n, K * rho) * np.sin(m * source / n) * np.sin(m * target / n)
    )
    direct = (np.abs(target - source) < np.pi) * np.exp(1j * K * rho * np.cos(target - source))
    # faces at 0 and n pi
    mirrored = (target + source < np.pi) * np.exp(1j * K * rho * np.cos(target + source))
    bent = coefficient(n, np.array(source), target, np.array(rho)) * np.exp(-1j * K * rho) / np.sqrt(rho)
    error = np.abs(direct - mirrored + bent - series.sum(axis=0))
    assert error.max() < 0.3 / (K * rho) ** 1.5


@pytest.mark.parametrize("n", [1.5, 2.0])
def test_borders_are_halves(n: float) -> None:
    """On the border of shadow half the incident field is missing, on that of reflection half the mirrored one; to 2 %.

    Bias: the other terms, of order 1 / sqrt(k L).
    """
    source, s, t = 0.8, np.array(10.0), np.array(10.0)
    distance = s * t / (s + t)
    shadow, mirror = source + np.pi, np.pi - source
    for border, part in ((shadow, 0), (mirror, 1)):
        for offset, sign in ((1e-9, 1.0), (-1e-9, -1.0)):
            terms = wedge_terms(np.array(n), np.array(source), np.array(border + offset), distance, WAVELENGTH_M, 1.0)
            # within 1e-7 rad of the shadow's border its dark side is taken, where walls' ends still hide
            expected = 0.5 if part == 0 else 0.5 * sign
            assert edge_field(terms[part], s, t) == pytest.approx(expected, abs=0.02)


def test_edges_work_both_ways() -> None:
    """Reciprocity: source and target exchanged, any wedge, same reflection; rounding."""
    rng = np.random.default_rng(3)
    n = rng.uniform(1.2, 2.0, 500)
    source, target = rng.uniform(0.01, 0.99, (2, 500)) * n * np.pi
    distance = rng.uniform(0.5, 20.0, 500)
    r = np.exp(1j)
    there, back = (
        0.8 * incident + r * first + 0.3 * r * last
        for incident, first, last in (
            wedge_terms(n, *ends, distance, WAVELENGTH_M, 1.0) for ends in ((source, target), (target, source))
        )
    )
    np.testing.assert_allclose(there, back, atol=1e-12)


@pytest.mark.parametrize("skew_deg", [90.0, 50.0, 20.0])
def test_far_from_all_borders_a_slanted_edge_is_kellers(skew_deg: float) -> None:
    """Where the transition function is 1 the coefficient is that of Keller's cone of rays:
    D = -e^{-j pi/4} / (2 n sqrt(2 pi k) sin(skew)) times the cotangents of (pi -+ b) / 2n, b the difference of the
    angles (incident) or their sum (last and first face). n = 3/2, source at 40 deg, target at 100 deg: cotangents of
    (180 + 60) / 3 = 80, (180 - 60) / 3 = 40, (180 + 140) / 3 and (180 - 140) / 3 = 13.33 deg. L = 1e6 m makes
    F = 1 + j / 2x differ from 1 by under 1e-8; tolerance 1e-7.
    """
    n, sine = 1.5, np.sin(np.radians(skew_deg))
    source, target = np.radians(40.0), np.radians(100.0)
    cot = {angle: 1.0 / np.tan(np.radians(angle)) for angle in (80.0, 40.0, 320.0 / 3.0, 40.0 / 3.0)}
    scale = -np.exp(-0.25j * np.pi) / (2.0 * n * np.sqrt(2.0 * np.pi * K) * sine)
    terms = wedge_terms(np.array(n), np.array(source), np.array(target), np.array(1e6), WAVELENGTH_M, np.array(sine))
    expected = [scale * (cot[80.0] + cot[40.0]), scale * cot[40.0 / 3.0], scale * cot[320.0 / 3.0]]
    np.testing.assert_allclose(terms, expected, rtol=1e-7)
    assert abs(terms[1]) * sine == pytest.approx(4.2193 / (3.0 * np.sqrt(2.0 * np.pi * K)), rel=1e-4)


def test_deep_shadow_decays() -> None:
    """Behind a metal half plane the field falls steadily from the border (-6 dB) to under -30 dB at 60 deg."""
    s, t = np.array(10.0), np.array(10.0)
    behind = np.pi + 0.5 + np.radians(np.linspace(0.0, 60.0, 61))
    field = np.abs(edge_field(coefficient(2.0, np.array(0.5), behind, s * t / (s + t)), s, t))
    assert (np.diff(field) < 0.0).all()
    assert 20.0 * np.log10(field[0]) == pytest.approx(-6.0, abs=0.3)
    assert 20.0 * np.log10(field[-1]) < -30.0


def test_mirrors_end_against_the_surface_integral() -> None:
    """Flat wall of 6 m, specular point led over its end: mirror and both ends against physical optics of the surface.

    Layout: source and targets 6 m in front. Bias: physical optics knows the edge by its own obliquity, which agrees
    at the border and departs as the edge's field fades; tolerance 2 % of the mirror's field.
    """
    a, b = np.array([-3.0, 6.0]), np.array([3.0, 6.0])
    origin = np.zeros(3)
    for x in np.linspace(3.0, 8.0, 41):
        target = np.array([x, 0.0, 0.0])
        length = np.hypot(x, 12.0)
        total = (0.5 * x <= 3.0) * np.exp(-1j * K * length) / length
        for end, inward in ((a, 1.0), (b, -1.0)):
            s, t = np.linalg.norm(end), np.linalg.norm(target[:2] - end)
            angles = [np.arctan2(end[1], inward * (place - end[0])) for place in (0.0, x)]
            arrays = [np.asarray(value) for value in (2.0, *angles, s * t / (s + t))]
            _, first, last = wedge_terms(*arrays, WAVELENGTH_M, 1.0)
            total += edge_field(first + last, s, t) * np.exp(-1j * K * (s + t)) / (s + t)
        exact = wall_field(origin, target, a, b, 0.0, WAVELENGTH_M)
        assert abs(total - exact) * length < 0.02, x


def test_the_compiled_error_function_on_its_ray() -> None:
    """e^{jx} erfc(e^{j pi/4} sqrt x) against SciPy's, 0 to 1e4; the share of a wave against Fresnel's integrals."""
    root = np.append(0.0, np.logspace(-6.0, 4.0, 2001))
    exact = wofz(1j * np.exp(0.25j * np.pi) * root)
    np.testing.assert_allclose([scaled_erfc(x) for x in root], exact, rtol=1e-13)
    argument = np.linspace(-30.0, 30.0, 601)
    sine, cosine = fresnel(argument)
    share = 0.5 + 0.5 * (1.0 + 1j) * (cosine - 1j * sine)
    np.testing.assert_allclose([passed_share_at(v) for v in argument], share, atol=1e-13)
