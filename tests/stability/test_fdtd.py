"""Hard cases of time stepping: the Courant limit, late times, metal, high contrast, single precision, subnormals."""

from __future__ import annotations

import dataclasses
import math

import mpmath
import numpy as np
import pytest

from lab.full_wave import grid as grid_module
from lab.full_wave import strip as strip_module
from lab.full_wave.cpml import SPEED_OF_LIGHT_MPS, VACUUM_PERMITTIVITY_F_PER_M, CpmlParams, recursion
from lab.full_wave.grid import Drive, GridParams, Media, YeeGrid
from lab.full_wave.rough import RoughParams
from lab.full_wave.scattering import reflect
from lab.full_wave.strip import Strip, StripParams, build_strips, courant_limit_s, run_strip
from models.physics.fresnel import half_space_reflection, slab_reflection
from tests.stability.catalogue import Errors

FREQUENCY_HZ = 10e9
WAVELENGTH_M = SPEED_OF_LIGHT_MPS / FREQUENCY_HZ
LIMIT = math.sqrt(0.5)


def stepped(
    courant: float,
    steps: int,
    eps: complex = 4.0 - 0.4j,
    rows: slice = slice(25, 40),
    pulse: complex = 1.0,
    dtype: str = "float32",
) -> YeeGrid:
    """A lossy block in absorbing air at a Courant number, checked or not, after so many steps."""
    params = GridParams(64, 64, 2e-3, FREQUENCY_HZ, absorber=CpmlParams(cells=12, leak=1e-6), dtype=dtype)
    object.__setattr__(params, "courant", courant)
    media = np.ones((64, 64), np.complex128)
    media[rows, 30:40] = eps
    grid = YeeGrid(params, Media(out=media))
    profile = np.zeros(64, np.complex128)
    profile[30:34] = pulse
    grid.run(Drive(22, profile, 6.0), (), steps, np.zeros((0, 64), np.complex128))
    return grid


def test_at_the_courant_limit_fields_decay() -> None:
    grid = stepped(LIMIT, 3000)
    assert grid.peak < 10.0
    assert grid.residue < 1e-3


def test_just_above_the_limit_is_refused() -> None:
    """A thousandth above: refused; a hundredth above and let through, it is caught once it is not finite."""
    with pytest.raises(ValueError, match=r"1/sqrt\(2\)"):
        GridParams(64, 64, 2e-3, FREQUENCY_HZ, courant=1.001 * LIMIT)
    with pytest.raises(FloatingPointError, match="not finite"):
        stepped(1.01 * LIMIT, 1024)


@pytest.mark.hard("lab.full_wave.grid", "a step 1 % above the limit, let through", 1.0, "",
                  "passive media and absorbers: no field outgrows its peak once the pulse is over")  # fmt: skip
def test_on_the_courant_limit_of_two_dimensions(errors: Errors) -> None:
    """Largest field after 192 steps, the source silent for 130, as a share of its peak. Above c dt = h / sqrt(2) the
    shortest waves grow at every step.
    """
    ours = stepped(LIMIT, 192)
    errors(naive=stepped(1.01 * LIMIT, 192).level / ours.peak, ours=ours.residue)


def test_strip_just_above_the_limit_is_refused() -> None:
    with pytest.raises(ValueError, match="stability limit"):
        StripParams(courant=1.0 + 1e-9)
    wall, _ = build_strips(((4.0, 0.01),), 0.5, FREQUENCY_HZ, StripParams())
    limit_s = courant_limit_s(wall.cell_m, wall.eps_r, wall.transverse_per_m)
    dataclasses.replace(wall, step_s=limit_s)
    with pytest.raises(ValueError, match="Courant limit"):
        dataclasses.replace(wall, step_s=limit_s * (1.0 + 1e-9))


def oblique_pair(angle_rad: float, checked: bool) -> tuple[Strip, Strip]:
    """A half-space of eps 2 and air alone: on the limit of the oblique wave, or on c dt = h unchecked."""
    pair = build_strips(((2.0, math.inf),), angle_rad, FREQUENCY_HZ, StripParams(8))
    wall = pair[0]
    normal_s = float((wall.cell_m * np.sqrt(wall.eps_r)).min() / SPEED_OF_LIGHT_MPS)
    # k_par rises as the step falls: a ten-thousandth of room
    oblique_s = 0.9999 * courant_limit_s(wall.cell_m, wall.eps_r, wall.transverse_per_m)
    step_s = oblique_s if checked else normal_s
    transverse_per_m = 2.0 / (SPEED_OF_LIGHT_MPS * step_s) * math.sin(math.pi * FREQUENCY_HZ * step_s)
    changes = {"step_s": step_s, "transverse_per_m": transverse_per_m * math.sin(angle_rad)}
    if checked:
        return dataclasses.replace(pair[0], **changes), dataclasses.replace(pair[1], **changes)
    for one in pair:
        for name, value in changes.items():
            object.__setattr__(one, name, value)
    return pair


def off_fresnel(pair: tuple[Strip, Strip], angle_rad: float) -> float:
    """Error of the half-space's reflection; infinite where the run ends in no number."""
    try:
        total, incident = (run_strip(one, FREQUENCY_HZ, "te", StripParams(8)) for one in pair)
    except FloatingPointError:
        return math.inf
    return abs((total.front - incident.front) / incident.front - half_space_reflection(2.0, math.cos(angle_rad)))


@pytest.mark.hard("lab.full_wave.strip", "c dt = h, the limit of a normal wave", 0.026, "",
                  "second order: (k h)^2 / 24 at 8 cells a wavelength")  # fmt: skip
def test_strip_on_the_limit_of_a_grazing_wave(errors: Errors) -> None:
    """74 deg from the normal: the phase along the wall takes 3 % off the longest step; r, all of the step used."""
    angle_rad = 1.3
    errors(
        naive=off_fresnel(oblique_pair(angle_rad, checked=False), angle_rad),
        ours=off_fresnel(oblique_pair(angle_rad, checked=True), angle_rad),
    )


def test_a_strip_past_infinity_is_no_answer() -> None:
    """Infinite, then NaN: the residue is then -1 / inf = 0, and looked like a field that has decayed."""
    with pytest.raises(FloatingPointError, match="not finite"):
        run_strip(oblique_pair(1.3, checked=False)[0], FREQUENCY_HZ, "te", StripParams(8))


def test_strip_on_the_limit_is_right() -> None:
    """The whole step that `StripParams` allows: still decays, still Fresnel."""
    params = StripParams(courant=1.0)
    wall, air = build_strips(((4.0, math.inf),), 0.7, FREQUENCY_HZ, params)
    total, incident = (run_strip(one, FREQUENCY_HZ, "te", params) for one in (wall, air))
    r = (total.front - incident.front) / incident.front
    assert total.residue < 1e-6
    assert abs(r - half_space_reflection(4.0, math.cos(0.7))) < 2e-3


@pytest.mark.parametrize("polarisation", ["te", "tm"])
def test_late_time_is_quiet(polarisation: str) -> None:
    """Lossless slabs guide waves whose tails reach into the absorbers: every run still decays to a millionth.

    TM at 25 deg on 6 mm of glass at 40 cells grew without end with kappa = 1, and charge stood still after a pulse with
    a direct part.
    """
    params = StripParams(40)
    for angle_deg in (0.0, 25.0, 60.0, 80.0):
        wall, _ = build_strips(((6.31, 6e-3),), math.radians(angle_deg), FREQUENCY_HZ, params)
        assert run_strip(wall, FREQUENCY_HZ, polarisation, params).residue < 1e-6  # type: ignore[arg-type]


@pytest.mark.hard("lab.full_wave.grid", "pulse even about its middle", 1e-6, "", "share of the peak at which runs end")
def test_a_pulse_with_a_direct_part_leaves_a_tail(errors: Errors) -> None:
    """Late time, 2048 steps: a direct part does not travel, it is the wake that fades last."""
    ours, naive = (stepped(0.7, 2048, pulse=pulse, dtype="float64").residue for pulse in (1.0, 1.0j))
    errors(naive=naive, ours=ours)


@pytest.mark.hard("lab.full_wave.grid", "float32 product of phase and step", 4e-10, "",
                  "rounding of the product: 2^-53 of 2.9e6 rad")  # fmt: skip
def test_phasors_after_ten_million_steps(errors: Errors) -> None:
    """Late time: the running Fourier sum turns by w dt n; one step after n = 1e7 is read off against 60 digits."""
    params = GridParams(64, 64, 2e-3, FREQUENCY_HZ)
    grid = YeeGrid(params, Media())
    grid.u[:] = 1.0
    grid.steps = 10_000_000
    spectra = np.zeros((1, 64), np.complex128)
    grid.run(Drive(22, np.zeros(64, np.complex128), 6.0), (30,), 1, spectra)
    with mpmath.workdps(60):
        exact = complex(mpmath.expj(-mpmath.mpf(params.phase_per_step) * grid.steps))
    naive = np.exp(np.complex64(-1j) * (np.float32(params.phase_per_step) * np.float32(grid.steps)))
    errors(naive=abs(naive - exact), ours=abs(spectra[0, 32] / grid.u[0, 33, 30] - exact))


@pytest.mark.parametrize("polarisation", ["te", "tm"])
@pytest.mark.parametrize("eps", [80.0 - 20.0j, 81.0 + 0j, 1.0 - 1e3j, 1.0 - 1e9j, 1.0 + 0j])
def test_high_contrast_and_every_loss(eps: complex, polarisation: str) -> None:
    """Water, conductors up to 1e9 times the vacuum's, and nothing at all; at 60 deg. Tolerance 5e-3 on r."""
    found = reflect(((eps, math.inf),), math.radians(60.0), FREQUENCY_HZ, polarisation)  # type: ignore[arg-type]
    exact = half_space_reflection(eps, 0.5, polarisation)  # type: ignore[arg-type]
    assert found.residue < 1e-6
    assert abs(found.r - exact) < 5e-3


def explicit_coefficients(eps_r: np.ndarray, sigma: np.ndarray, step_s: float) -> tuple[np.ndarray, np.ndarray]:
    """The current of the old field alone: E <- (1 - 2 l) E + curl / eps."""
    return 1.0 - sigma * step_s / (VACUUM_PERMITTIVITY_F_PER_M * eps_r), 1.0 / eps_r


@pytest.mark.hard("lab.full_wave.media", "current from the old field alone", 4.1e-3, "",
                  "second order: (k h)^2 / 24 at 20 cells a wavelength")  # fmt: skip
@pytest.mark.parametrize("loss", [1e3, 1e9])
def test_metal(loss: float, errors: Errors, monkeypatch: pytest.MonkeyPatch) -> None:
    """r of eps = 1 - loss j at 60 deg, TE: the update's factor 1 - sigma dt / eps is below -1 and grows."""

    def error() -> float:
        try:
            found = reflect(((1.0 - loss * 1j, math.inf),), math.radians(60.0), FREQUENCY_HZ, "te")
        except FloatingPointError:
            return math.inf
        return abs(found.r - half_space_reflection(1.0 - loss * 1j, 0.5, "te"))

    ours = error()
    monkeypatch.setattr(strip_module, "electric_coefficients", explicit_coefficients)
    errors(naive=error(), ours=ours)


def test_opaque_slab_is_a_half_space() -> None:
    """A metre of 80 - 20j: e^-230 behind it. r is that of the half-space, t is nothing and no warning."""
    found = reflect(((80.0 - 20.0j, 1.0),), 0.0, FREQUENCY_HZ, "te", RoughParams(10, dtype="float64"))
    assert abs(found.r - slab_reflection(80.0 - 20.0j, 1.0, math.inf, WAVELENGTH_M)) < 5e-3
    assert abs(found.t) < 1e-12


@pytest.mark.hard("lab.full_wave", "exp(-x) - 1 in float32", 1e-7, "", "one rounding to float32")
def test_recursion_in_single_precision_needs_expm1(errors: Errors) -> None:
    """Weak absorption, x of 1e-11 and 1e-8: b - 1 formed in float32 is zero, the layer gone (in float64 it keeps five
    digits of the one and eight of the other).
    """
    step_s = 1e-12
    sigma = np.array([1e-11, 1e-8, 1e-4]) * VACUUM_PERMITTIVITY_F_PER_M / step_s
    one, zero = np.ones(3), np.zeros(3)
    _, drive = recursion(sigma, one, zero, step_s)
    x = sigma * step_s / VACUUM_PERMITTIVITY_F_PER_M
    exact = -x + 0.5 * np.square(x)
    naive = np.exp(-x.astype(np.float32)) - np.float32(1.0)
    errors(naive=np.abs(naive / exact - 1.0).max(), ours=np.abs(drive.astype(np.float32) / exact - 1.0).max())


@pytest.mark.hard("lab.full_wave.cpml", "sigma (b - 1) / (kappa (sigma + kappa alpha))", 1e-15, "",
                  "no stretching: decay 1 and drive 0, to rounding")  # fmt: skip
def test_recursion_outside_of_the_layer(errors: Errors) -> None:
    """Neither sigma nor alpha: the drive as printed is 0 / 0."""
    zero, one = np.zeros(1), np.ones(1)
    decay, drive = recursion(zero, one, zero, 1e-12)
    with np.errstate(invalid="ignore"):
        naive = zero * (np.exp(-zero) - one) / (one * (zero + one * zero))
    errors(naive=abs(naive[0]), ours=abs(drive[0]) + abs(decay[0] - 1.0))


def subnormal_cells(steps: int) -> int:
    """Subnormal numbers in fields and absorbers of a metal wall that reaches into the absorbers at its sides."""
    grid = stepped(0.7, steps, eps=1.0 - 1e9j, rows=slice(None))
    arrays = (grid.u, grid.vx, grid.vz, *grid.psi_x, *grid.psi_z)
    tiny = np.finfo(np.float32).tiny
    return sum(int(np.count_nonzero((array != 0.0) & (np.abs(array) < tiny))) for array in arrays)


@pytest.mark.hard("lab.full_wave.grid", "no flush to zero", 0.0, "cells",
                  "every 64th step ends with a flush of all below 1e-30")  # fmt: skip
def test_no_subnormal_numbers_in_metal(errors: Errors, monkeypatch: pytest.MonkeyPatch) -> None:
    """float32, after 640 steps: a cell of metal leaves 1e-9 of a field, two in a row 1e-18, five a subnormal number,
    in which processors are slow.
    """
    ours = subnormal_cells(640)
    monkeypatch.setattr(grid_module, "_level_and_flush", lambda u, vx, vz: float(np.abs(u).max()))
    monkeypatch.setattr(grid_module, "FLUSHED", 0.0)
    errors(naive=subnormal_cells(640), ours=ours)


def test_no_subnormal_numbers_are_left() -> None:
    """float32 deep in a lossy block, long after the pulse: nothing between 0 and 1e-37, where steps turn slow."""
    grid = stepped(0.7, 6400, eps=10.0 - 9.0j)
    for field in (grid.u, grid.vx, grid.vz):
        assert not ((field != 0.0) & (np.abs(field) < 1e-37)).any()
