"""Hard cases of time stepping: the Courant limit, late times, metal, high contrast, single precision, subnormals."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from models.physics.fresnel import half_space_reflection, slab_reflection
from sim_player.fdtd import reflect
from sim_player.fdtd.cpml import SPEED_OF_LIGHT_MPS, VACUUM_PERMITTIVITY_F_PER_M, CpmlParams, recursion
from sim_player.fdtd.grid import Drive, GridParams, Media, YeeGrid
from sim_player.fdtd.strip import StripParams, build_strips, courant_limit_s, run_strip
from tests.stability.catalogue import Errors

FREQUENCY_HZ = 10e9
WAVELENGTH_M = SPEED_OF_LIGHT_MPS / FREQUENCY_HZ
LIMIT = math.sqrt(0.5)


def stepped(courant: float, steps: int, eps: complex = 4.0 - 0.4j) -> YeeGrid:
    """A lossy block in absorbing air at a Courant number, checked or not, after so many steps."""
    params = GridParams(64, 64, 2e-3, FREQUENCY_HZ, absorber=CpmlParams(cells=12, leak=1e-6))
    object.__setattr__(params, "courant", courant)
    media = np.ones((64, 64), np.complex128)
    media[25:40, 30:40] = eps
    grid = YeeGrid(params, Media(out=media))
    profile = np.zeros(64, np.complex128)
    profile[30:34] = 1.0
    grid.run(Drive(22, profile, 6.0), (), steps, np.zeros((0, 64), np.complex128))
    return grid


def test_at_the_courant_limit_fields_decay() -> None:
    grid = stepped(LIMIT, 3000)
    assert grid.peak < 10.0
    assert grid.residue < 1e-3


def test_just_above_the_limit_is_refused_and_would_explode() -> None:
    """A thousandth above: refused; let through, it doubles every few dozen steps."""
    with pytest.raises(ValueError, match=r"1/sqrt\(2\)"):
        GridParams(64, 64, 2e-3, FREQUENCY_HZ, courant=1.001 * LIMIT)
    assert stepped(1.01 * LIMIT, 192).level > 1e6
    with pytest.raises(FloatingPointError, match="not finite"):
        stepped(1.01 * LIMIT, 1024)


def test_strip_just_above_the_limit_is_refused() -> None:
    with pytest.raises(ValueError, match="stability limit"):
        StripParams(courant=1.0 + 1e-9)
    wall, _ = build_strips(((4.0, 0.01),), 0.5, FREQUENCY_HZ, StripParams())
    limit_s = courant_limit_s(wall.cell_m, wall.eps_r, wall.transverse_per_m)
    dataclasses.replace(wall, step_s=limit_s)
    with pytest.raises(ValueError, match="Courant limit"):
        dataclasses.replace(wall, step_s=limit_s * (1.0 + 1e-9))


def test_strip_on_the_limit_is_right() -> None:
    """The whole step the scheme allows: still decays, still Fresnel."""
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


def test_two_dimensions_stay_quiet_for_ten_thousand_steps() -> None:
    grid = stepped(0.7, 10_000)
    assert grid.residue < 1e-5
    assert np.isfinite(grid.energy())


@pytest.mark.parametrize("polarisation", ["te", "tm"])
@pytest.mark.parametrize("eps", [80.0 - 20.0j, 81.0 + 0j, 1.0 - 1e3j, 1.0 - 1e9j, 1.0 + 0j])
def test_high_contrast_and_every_loss(eps: complex, polarisation: str) -> None:
    """Water, conductors up to 1e9 times the vacuum's, and nothing at all; at 60 deg. Tolerance 5e-3 on r."""
    found = reflect(((eps, math.inf),), math.radians(60.0), FREQUENCY_HZ, polarisation)  # type: ignore[arg-type]
    exact = half_space_reflection(eps, 0.5, polarisation)  # type: ignore[arg-type]
    assert found.residue < 1e-6
    assert abs(found.r - exact) < 5e-3


def test_opaque_slab_is_a_half_space() -> None:
    """A metre of 80 - 20j: e^-230 behind it. r is that of the half-space, t is nothing and no warning."""
    found = reflect(((80.0 - 20.0j, 1.0),), 0.0, FREQUENCY_HZ, "te", 10)
    assert abs(found.r - slab_reflection(80.0 - 20.0j, 1.0, math.inf, WAVELENGTH_M)) < 5e-3
    assert abs(found.t) < 1e-12


@pytest.mark.hard(
    where="sim_player.fdtd",
    naive="exp(-x) - 1 in float32",
    bound=1e-7,
    unit="",
    source="one rounding to float32",
)
def test_recursion_in_single_precision_needs_expm1(errors: Errors) -> None:
    """Weak absorption, x = 1e-8: b - 1 formed in float32 is zero, the layer gone; expm1 keeps all digits."""
    step_s = 1e-12
    sigma = np.array([1e-8, 1e-6, 1e-4]) * VACUUM_PERMITTIVITY_F_PER_M / step_s
    one, zero = np.ones(3), np.zeros(3)
    _, drive = recursion(sigma, one, zero, step_s)
    x = sigma * step_s / VACUUM_PERMITTIVITY_F_PER_M
    exact = -x + 0.5 * np.square(x)
    naive = np.exp(-x.astype(np.float32)) - np.float32(1.0)
    errors(naive=np.abs(naive / exact - 1.0).max(), ours=np.abs(drive.astype(np.float32) / exact - 1.0).max())


def test_no_subnormal_numbers_are_left() -> None:
    """float32 deep in a lossy block, long after the pulse: nothing between 0 and 1e-37, where steps turn slow."""
    grid = stepped(0.7, 6400, eps=10.0 - 9.0j)
    for field in (grid.u, grid.vx, grid.vz):
        assert not ((field != 0.0) & (np.abs(field) < 1e-37)).any()
