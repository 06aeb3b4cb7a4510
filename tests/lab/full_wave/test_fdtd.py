"""FDTD against the exact reflection of smooth walls, energy, absorbers, and the Rayleigh factor of rough ones."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from lab.full_wave.cpml import SPEED_OF_LIGHT_MPS, VACUUM_PERMITTIVITY_F_PER_M, CpmlParams
from lab.full_wave.grid import Drive, GridParams, Media, YeeGrid
from lab.full_wave.media import real_medium
from lab.full_wave.rough import RoughParams, rough_profile
from lab.full_wave.scattering import reflect, reflect_angles
from lab.full_wave.smooth import SmoothWall
from lab.full_wave.strip import StripParams, build_strips
from models.physics.fresnel import (
    Polarisation,
    coherent_power,
    half_space_reflection,
    slab_reflection,
    slab_transmission,
    stack_reflection,
    stack_transmission,
)
from models.physics.materials import permittivity

FREQUENCY_HZ = 10e9
WAVELENGTH_M = SPEED_OF_LIGHT_MPS / FREQUENCY_HZ
CONCRETE = permittivity("concrete", FREQUENCY_HZ)
GLASS = permittivity("glass", FREQUENCY_HZ)
ANGLES_RAD = np.radians(np.arange(0.0, 81.0, 10.0))
POLARISATIONS: tuple[Polarisation, ...] = ("te", "tm")


def error(eps: complex, thickness_m: float, polarisation: Polarisation, cells: float, dtype: str = "float64") -> float:
    """Relative L2 of complex r over the angles against the closed form."""
    found = reflect_angles(
        ((eps, thickness_m),), ANGLES_RAD, FREQUENCY_HZ, polarisation, RoughParams(cells, dtype=dtype)
    )
    exact = slab_reflection(eps, np.cos(ANGLES_RAD), thickness_m, WAVELENGTH_M, polarisation)
    return float(np.linalg.norm([one.r for one in found] - exact) / np.linalg.norm(exact))


@pytest.mark.parametrize("polarisation", POLARISATIONS)
@pytest.mark.parametrize(("eps", "thickness_m"), [(CONCRETE, math.inf), (GLASS, 6e-3)])
def test_reflection_is_fresnels_to_second_order(eps: complex, thickness_m: float, polarisation: Polarisation) -> None:
    """Layout: one Bloch column, CPML in air and in the last medium. Analytic: slab formula, sign of TM as Eq. (13).

    Bias: second order in the cell, 2.5e-3 at most at 20 cells. Tolerance 3e-3, fall by 3 to 5 per halving.
    """
    coarse, fine = (error(eps, thickness_m, polarisation, cells) for cells in (10, 20))
    assert fine < 3e-3
    assert 3.0 < coarse / fine < 5.0


@pytest.mark.parametrize("polarisation", POLARISATIONS)
def test_slab_of_half_a_wave_is_clear(polarisation: Polarisation) -> None:
    """Layout: lossless slab, eps 4, 0.25 wavelengths. Analytic: r = 0, |t| = 1 at normal incidence.

    Bias: dispersion moves the resonance by 1e-5 of its frequency. Tolerance 1e-3.
    """
    found = reflect(((4.0, 0.25 * WAVELENGTH_M),), 0.0, FREQUENCY_HZ, polarisation)
    assert abs(found.r) < 1e-3
    assert abs(found.t) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("polarisation", POLARISATIONS)
def test_metal_is_a_mirror(polarisation: Polarisation) -> None:
    """Layout: half-space of 1e7 S/m at 60 deg, cells of its own skin. Analytic: Fresnel, -1 (TE), +1 (TM) to 1e-3.

    Bias: finite eps_r of the conductor, 1e-7. Tolerance 1e-4, below its distance from a perfect mirror.
    """
    metal = permittivity("metal", FREQUENCY_HZ)
    found = reflect(((metal, math.inf),), math.radians(60.0), FREQUENCY_HZ, polarisation)
    exact = half_space_reflection(metal, 0.5, polarisation)
    assert abs(found.r - exact) < 1e-4
    assert abs(exact - (-1.0 if polarisation == "te" else 1.0)) > 1e-4


@pytest.mark.parametrize("factor", [1.0, 100.0])
def test_good_conductors_need_no_shorter_steps(factor: float) -> None:
    """Layout: half-space of 1e7 S/m and of 100 times that at 60 deg; cells of the skin shrink as 1 / sqrt(loss).

    Analytic: waves in it as slow as that, so that every metal takes 20 / 0.99 sqrt(500) = 452 steps a period of 20
    cells; with eps_r 1 they were 1e5. Its r stays, to 1e-6: displacement is nothing beside conduction.
    """
    metal = 1.0 + 1j * factor * permittivity("metal", FREQUENCY_HZ).imag
    column, _ = build_strips(((metal, math.inf),), math.radians(60.0), FREQUENCY_HZ, StripParams())
    assert 1.0 / (FREQUENCY_HZ * column.step_s) == pytest.approx(20.0 / 0.99 * math.sqrt(500.0), rel=1e-3)
    eps_r, sigma = real_medium(metal, FREQUENCY_HZ)
    stepped = complex(eps_r, -sigma / (2.0 * math.pi * FREQUENCY_HZ * VACUUM_PERMITTIVITY_F_PER_M))
    for polarisation in POLARISATIONS:
        exact = half_space_reflection(metal, 0.5, polarisation)
        assert abs(half_space_reflection(stepped, 0.5, polarisation) - exact) < 1e-6


@pytest.mark.parametrize("polarisation", POLARISATIONS)
def test_power_is_conserved(polarisation: Polarisation) -> None:
    """Layout: lossless then lossy slab at 50 deg. Analytic: R + T = 1; R + T = 1 - A of the slab formula.

    Bias: lossless none but the run's end (1e-6), lossy second order. Tolerance 1e-4 and 3e-3.
    """
    angle_rad, depth_m = math.radians(50.0), 0.02
    clear = reflect(((4.0, depth_m),), angle_rad, FREQUENCY_HZ, polarisation)
    assert clear.reflected_power + clear.transmitted_power == pytest.approx(1.0, abs=1e-4)
    found = reflect(((4.0 - 0.4j, depth_m),), angle_rad, FREQUENCY_HZ, polarisation)
    shape = (4.0 - 0.4j, np.cos(angle_rad), depth_m, WAVELENGTH_M, polarisation)
    exact = abs(slab_reflection(*shape)) ** 2 + abs(slab_transmission(*shape)) ** 2
    assert found.reflected_power + found.transmitted_power == pytest.approx(exact, abs=3e-3)
    assert exact < 0.9


@pytest.mark.parametrize("polarisation", POLARISATIONS)
def test_double_glazing_resonates_as_the_stack_does(polarisation: Polarisation) -> None:
    """Layout: 4 mm glass, 12 mm air, 4 mm glass, 0..80 deg, 40 cells. Analytic: stack of layers.

    Bias: second order, the two panes multiply it. Tolerance 5e-3 relative L2 of r and t.
    """
    window = ((GLASS, 4e-3), (1.0 + 0j, 12e-3), (GLASS, 4e-3))
    found = reflect_angles(window, ANGLES_RAD, FREQUENCY_HZ, polarisation, RoughParams(40, dtype="float64"))
    stack = (*(list(column) for column in zip(*window, strict=True)), np.cos(ANGLES_RAD), WAVELENGTH_M, polarisation)
    for got, exact in (
        ([one.r for one in found], stack_reflection(*stack)),
        ([one.t for one in found], stack_transmission(*stack)),
    ):
        assert np.linalg.norm(got - exact) / np.linalg.norm(exact) < 5e-3


def test_a_smooth_wall_is_stepped_in_the_number_type_asked_for() -> None:
    """Layout: half-space of brick at 40 deg, 10 cells. float64 by default; float32 differs by its rounding, 1e-7."""
    brick = SmoothWall(FREQUENCY_HZ, "brick", math.inf, "te")
    double, same, single = (
        brick.simulated(np.radians([40.0]), 10.0, *dtype)[0].r for dtype in ((), ("float64",), ("float32",))
    )
    assert same == double
    assert 0.0 < abs(single - double) < 1e-5


def test_angles_on_threads_are_the_angles_one_by_one() -> None:
    layers = ((GLASS, 6e-3),)
    found = reflect_angles(layers, ANGLES_RAD[:3], FREQUENCY_HZ, workers=2)
    assert [one.r for one in found] == [reflect(layers, float(angle), FREQUENCY_HZ).r for angle in ANGLES_RAD[:3]]


def point_source_run(cells: int, steps: int, sides: int) -> tuple[np.ndarray, YeeGrid]:
    """|u| along a row of 60 cells around a source in the middle of an air domain, each 8 steps."""
    params = GridParams(cells, cells, 2e-3, FREQUENCY_HZ, absorber=CpmlParams(cells=sides, leak=1e-6))
    grid = YeeGrid(params, Media())
    profile = np.zeros(cells, np.complex128)
    profile[cells // 2] = 1.0
    drive = Drive(cells // 2, profile, 1.0 / (0.15 * params.phase_per_step))
    middle, seen = cells // 2, []
    for _ in range(steps // 8):
        grid.run(drive, (), 8, np.zeros((0, cells), np.complex128))
        seen.append(grid.u[0, middle - 29 : middle + 31, middle + 20].astype(np.float64))
    return np.array(seen), grid


def test_absorber_sends_back_nothing_to_speak_of() -> None:
    """Layout: source in 120 cells of air with 20 cells of CPML, a row 20 cells off; and a domain with walls too far.

    Analytic: nothing returns. Bias: discretised grading and corners, -108 dB. Tolerance -90 dB of the largest
    field, well below the -60 dB wanted, so that a broken profile shows.
    """
    near, _ = point_source_run(120, 300, 20)
    far, _ = point_source_run(320, 300, 20)
    level_db = 20.0 * math.log10(np.abs(near - far).max() / np.abs(far).max())
    assert level_db < -90.0


def test_energy_never_grows() -> None:
    """Layout: lossless block in absorbing air, energy each 64 steps over 10 transits after the pulse. Analytic: falls.

    Bias: E and H are half a step apart, the sum wavers. Tolerance 1e-6 of the first energy; a millionth is left.
    """
    params = GridParams(90, 90, 2e-3, FREQUENCY_HZ, absorber=CpmlParams(cells=20, leak=1e-6))
    eps = np.ones((90, 90), np.complex128)
    eps[35:55, 45:60] = 4.0
    grid = YeeGrid(params, Media(out=eps))
    drive = Drive(30, np.exp(-np.square((np.arange(90) - 45.0) / 8.0)).astype(np.complex128), 8.0)
    grid.run(drive, (), drive.steps, np.zeros((0, 90), np.complex128))
    transit_steps = round(math.sqrt(2.0) * 90 * 2.0 / params.courant)
    energies = []
    for _ in range(10 * transit_steps // 64):
        grid.run(drive, (), 64, np.zeros((0, 90), np.complex128))
        energies.append(grid.energy())
    first, last = energies[0], energies[-1]
    rises = [later - before for before, later in itertools.pairwise(energies)]
    assert max(rises) < 1e-6 * first
    assert last < 1e-6 * first


def test_wide_strip_without_roughness_is_one_column() -> None:
    """A height of 1 nm on 12 columns: the flat wall, nothing diffuse. Bias: square cells at 10, second order, 0.02."""
    layers, angle_rad = ((CONCRETE, math.inf),), math.radians(40.0)
    wide = reflect(layers, angle_rad, FREQUENCY_HZ, "te", RoughParams(10, 1e-9, width_m=0.015, correlation_m=0.01))
    exact = half_space_reflection(CONCRETE, math.cos(angle_rad), "te")
    assert abs(wide.r - exact) < 0.02
    assert wide.reflected_power == pytest.approx(wide.specular_power, rel=1e-4)


def test_a_strip_scatters_as_a_grating_of_its_width() -> None:
    """Layout: concrete, 1 mm rms, normal incidence, a strip of 2.5 wavelengths. Analytic: sin = m / 2.5, |m| <= 2.

    Bias: the width is a whole number of cells (1 %), dispersion 0.3 %. Tolerance 0.015 on the sine.
    """
    settings = RoughParams(8, 1e-3, 0.01, 2.5 * WAVELENGTH_M, seed=1)
    angle_rad, _ = reflect(((CONCRETE, math.inf),), 0.0, FREQUENCY_HZ, "te", settings).orders
    np.testing.assert_allclose(np.sort(np.sin(angle_rad)), np.arange(-2, 3) / 2.5, atol=0.015)


@pytest.mark.slow
def test_rough_metal_sends_back_all_it_gets() -> None:
    """Oblique and rough: every order counts, at its own angle. Layout: metal, 4 mm rms, 4 cm, 60 deg, 10 GHz, TE.

    Analytic: reflected power 1 (loss of metal 1e-4). Orders of the wrong sign gave 0.81..0.97. Tolerance 0.01.
    """
    layers = ((permittivity("metal", FREQUENCY_HZ), math.inf),)
    rough = reflect(layers, math.radians(60.0), FREQUENCY_HZ, "te", RoughParams(12, 4e-3, 0.04, 0.45, seed=1))
    assert rough.specular_power < 0.9
    assert rough.reflected_power == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
def test_rough_wall_keeps_the_rayleigh_share() -> None:
    """Layout: concrete, TE, 45 deg, rms 2 mm, correlation 4 cm, width 0.45 m, 8 cells. Analytic: exp(-g), -1.53 dB.

    Bias: one surface of 11 correlation lengths scatters by 0.2 dB; slopes of 4 deg. Tolerance 0.5 dB; what leaves the
    lobe is found in other directions: all reflected power is that of the smooth wall to 5 %.
    """
    layers, angle_rad = ((CONCRETE, math.inf),), math.radians(45.0)
    rough = reflect(layers, angle_rad, FREQUENCY_HZ, "te", RoughParams(8, 2e-3, 0.04, 0.45, seed=1))
    smooth = reflect(layers, angle_rad, FREQUENCY_HZ)
    share_db = 10.0 * math.log10(rough.specular_power / smooth.specular_power)
    exact_db = 10.0 * math.log10(coherent_power(2e-3, math.cos(angle_rad), WAVELENGTH_M))
    assert share_db == pytest.approx(exact_db, abs=0.5)
    assert rough.reflected_power == pytest.approx(smooth.reflected_power, rel=0.05)
    assert rough.orders[1].sum() == rough.reflected_power


def test_same_seed_same_bytes() -> None:
    layers = ((CONCRETE, math.inf),)
    runs = [reflect(layers, 0.3, FREQUENCY_HZ, "te", RoughParams(6, 1e-3, 0.01, 0.1, seed=seed)) for seed in (7, 7, 8)]
    assert runs[0].r == runs[1].r
    assert runs[0].orders[1].tobytes() == runs[1].orders[1].tobytes()
    assert runs[0].r != runs[2].r


def test_surface_has_the_wanted_statistics() -> None:
    """Zero mean, rms exactly as asked, correlation exp(-1) at one correlation length (400 lengths: 0.1)."""
    width_m, points = 4.0, 4_000
    heights = rough_profile(width_m, 1e-3, 0.01, 3, np.arange(points) * width_m / points)
    assert abs(heights.mean()) < 1e-12
    assert heights.std() == pytest.approx(1e-3, rel=1e-9)
    lag = np.mean(heights * np.roll(heights, 10)) / np.mean(heights**2)
    assert lag == pytest.approx(math.exp(-1.0), abs=0.1)


@pytest.mark.parametrize(
    ("layers", "options", "rule"),
    [
        ((), {}, "at least one"),
        (((4.0 + 1.0j, 0.1),), {}, "Im <= 0"),
        (((0.5, 0.1),), {}, "Re >= 1"),
        (((4.0, 0.0),), {}, "positive"),
        (((4.0, math.inf), (4.0, 0.1)), {}, "only in the last"),
        (((4.0, 0.1),), {"angle_rad": math.radians(89.5)}, "89 deg"),
        (((4.0, 0.1),), {"angle_rad": math.nan}, "89 deg"),
        (((4.0, 0.1),), {"frequency_hz": 0.0}, "positive"),
        (((4.0, 0.1),), {"polarisation": "hh"}, "te or tm"),
        (((4.0, 0.1),), {"settings": {"cells_per_wavelength": 2.0}}, "at least 4"),
        (((4.0, 0.1),), {"settings": {"dtype": "float16"}}, "float32 or float64"),
        (((4.0, 0.1),), {"settings": {"roughness_m": -1e-3}}, "roughness_m"),
        (((4.0, 0.005),), {"settings": {"roughness_m": 5e-3}}, "pierces"),
        (((1.0 - 1e6j, math.inf),), {"settings": {"roughness_m": 1e-3}, "polarisation": "tm"}, "good conductor"),
    ],
)
def test_bad_input_is_refused(layers: tuple, options: dict, rule: str) -> None:
    wave = {"angle_rad": 0.1, "frequency_hz": FREQUENCY_HZ} | options
    settings = wave.pop("settings", {})
    with pytest.raises(ValueError, match=rule):
        reflect(layers, **wave, settings=RoughParams(**settings))
