"""Yee grid in two dimensions, x along the wall and z into it, with CPML; TE (E out of plane) and TM (H out of plane).

One scheme serves both by duality: u at (i, k) points out of the plane, vx at (i, k + 1/2), vz at (i + 1/2, k) in it.
TE: u = E_y, vx = eta0 H_x, vz = eta0 H_z. TM: u = eta0 H_y, vx = -E_x, vz = -E_z.
    vx <- a vx + b du/dz      vz <- a vz - b du/dx      u <- a u + b (dvx/dz - dvz/dx)
Under a Bloch condition fields are complex: parts 0 and 1 are real and imaginary, coupled only where x wraps around.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numba.extending import overload

from lab.full_wave.cpml import SPEED_OF_LIGHT_MPS, CpmlParams, layer
from lab.full_wave.media import electric_coefficients, real_medium
from models.physics.fresnel import Polarisation

#: Absorber of a plain grid.
ABSORBER = CpmlParams(cells=20, leak=1e-6)
#: Of a pulse, in deviations.
HALF_LENGTH = 5.0
#: Steps between checks of the field's level (and flushes of nearly subnormal numbers).
LOOK_STEPS = 64
#: Smaller values become zero, long before subnormal numbers slow the steps.
FLUSHED = 1e-30
#: Steps that a row takes while it is in the cache, where a node alone is driven and read.
SKEWED_STEPS = 16
#: Below so many cells (of all parts) a step is too short to share between threads on a busy machine.
PARALLEL_CELLS = 400_000


@dataclass(frozen=True)
class Media:
    """Complex permittivity where each E component lives, [nx, nz]: TE uses `out`, TM uses `along` and `normal`."""

    out: np.ndarray | None = None
    along: np.ndarray | None = None
    normal: np.ndarray | None = None


@dataclass(frozen=True)
class GridParams:
    """Square cells and steps of a grid; without a Bloch phase the sides absorb as the ends do."""

    cells_x: int
    cells_z: int
    cell_m: float
    frequency_hz: float
    polarisation: Polarisation = "te"
    #: Phase k_par times width of the periodic strip, or None for absorbing sides.
    bloch_rad: float | None = None
    #: k_normal / k0 at the low and the high end of z, for the strength of the absorbers.
    normal_index: tuple[float, float] = (1.0, 1.0)
    absorber: CpmlParams = ABSORBER
    #: c dt / cell; the limit of two dimensions is 1 / sqrt(2).
    courant: float = 0.7
    dtype: str = "float32"

    def __post_init__(self) -> None:
        if not 0.0 < self.courant <= math.sqrt(0.5):
            raise ValueError(f"courant must lie in (0, 1/sqrt(2)], the limit in 2-D, got {self.courant!r}")
        if self.dtype not in ("float32", "float64"):
            raise ValueError(f"dtype must be float32 or float64, got {self.dtype!r}")
        if self.cells_x < 1 or self.cells_z <= 2 * self.absorber.cells + 2:
            raise ValueError(f"grid of {self.cells_x} x {self.cells_z} cells is too small for its absorbers")
        if self.bloch_rad is None and self.cells_x <= 2 * self.absorber.cells + 2:
            raise ValueError(f"cells_x = {self.cells_x} leaves no room between the absorbing sides")

    @property
    def step_s(self) -> float:
        """Time step [s]."""
        return self.courant * self.cell_m / SPEED_OF_LIGHT_MPS

    @property
    def phase_per_step(self) -> float:
        """Carrier phase of one step [rad]."""
        return 2.0 * math.pi * self.frequency_hz * self.step_s

    @property
    def grid_wave_number(self) -> float:
        """(2 / c dt) sin(w dt / 2) [rad/m]: k0 on the grid."""
        return 2.0 / (self.courant * self.cell_m) * math.sin(0.5 * self.phase_per_step)

    def wave_number(self, symbol: float) -> float:
        """Return the wave number whose central difference (2/h) sin(k h / 2) is `symbol` [rad/m]."""
        return 2.0 / self.cell_m * math.asin(0.5 * self.cell_m * symbol)


@dataclass(frozen=True)
class Drive:
    """Pulse on a row of u: row, complex profile along x [nx], deviation [steps].

    The pulse is odd about its middle: a DC part would leave static charge. A real grid carries the
    real part of profile times the analytic pulse, so a phase along x steers the beam.
    """

    row: int
    profile: np.ndarray
    deviation_steps: float

    @property
    def steps(self) -> int:
        """Length of the pulse in steps."""
        return int(2.0 * HALF_LENGTH * self.deviation_steps)


class YeeGrid:
    """Fields, coefficients and the step of one grid."""

    def __init__(self, params: GridParams, media: Media) -> None:
        self.params = params
        dtype = np.dtype(params.dtype)
        nx, nz, self.parts = params.cells_x, params.cells_z, 1 if params.bloch_rad is None else 2
        self.u, self.vx, self.vz = (np.zeros((self.parts, nx + 2, nz), dtype) for _ in range(3))
        vacuum = (dtype.type(1.0), dtype.type(params.courant))
        if params.polarisation == "te":
            self.at_u, self.at_vx, self.at_vz = self._medium(media.out), vacuum, vacuum
        else:
            self.at_u, self.at_vx, self.at_vz = vacuum, self._medium(media.along), self._medium(media.normal)
        cells = params.absorber.cells
        sides = cells if params.bloch_rad is None else 0
        self.along_z = self._absorbers(np.arange(float(nz)), nz - 1.0, params.normal_index)
        self.along_x = self._absorbers(np.arange(nx + 2.0), nx + 1.0, (1.0, 1.0) if sides else None)
        self.psi_z = tuple(np.zeros((self.parts, nx + 2, 2 * cells), dtype) for _ in range(2))
        self.psi_x = tuple(np.zeros((self.parts, 2 * sides, nz), dtype) for _ in range(2))
        phase = params.bloch_rad or 0.0
        self.wrap = (dtype.type(math.cos(phase)), dtype.type(math.sin(phase)), params.bloch_rad is not None)
        self.steps = 0
        self.peak = 0.0
        self.level = 0.0

    def run(self, drive: Drive, rows: tuple[int, ...], steps: int, spectra: np.ndarray) -> None:
        """Take `steps` steps; add the phasors of u at rows to spectra complex128 [rows, nx]."""
        source = np.stack([drive.profile.real, drive.profile.imag])
        shape = (float(drive.row), self.params.phase_per_step, drive.deviation_steps)
        threads = numba.get_num_threads()
        numba.set_num_threads(threads if self.u.size >= PARALLEL_CELLS else 1)
        taken = 0
        while taken < steps:
            batch = min(LOOK_STEPS, steps - taken)
            _run(
                self.u,
                self.vx,
                self.vz,
                self.at_u,
                self.at_vx,
                self.at_vz,
                self.along_z,
                self.along_x,
                self.psi_z,
                self.psi_x,
                self.wrap,
                source,
                shape,
                np.array(rows, np.int64),
                spectra,
                self.steps,
                batch,
            )
            taken += batch
            self.settle(batch)
        numba.set_num_threads(threads)

    def run_node(self, node: tuple[int, int], drive: np.ndarray, part: tuple[int, int, int, int]) -> np.ndarray:
        """Add `drive` float64 [steps] to u at a node (i, k), step by step, and return u there, float64 [steps].

        `part` (first and end of x, first and end of z) is stepped, on one core: elsewhere the field must be zero still,
        or too far away to matter. No Bloch condition. Raises FloatingPointError where the field is not finite.
        """
        record = np.zeros(len(drive))
        media = (self.at_u, self.at_vx, self.at_vz)
        absorbers = (self.along_z, self.along_x, self.psi_z, self.psi_x)
        threads = numba.get_num_threads()
        numba.set_num_threads(1)
        _run_node(self.u, self.vx, self.vz, *media, *absorbers, part, node, drive, record)
        self.settle(len(drive))
        numba.set_num_threads(threads)
        return record

    def settle(self, steps: int) -> None:
        """Count steps taken, look at the field's level, set nearly subnormal numbers to zero."""
        self.steps += steps
        self.level = float(_level_and_flush(self.u, self.vx, self.vz))
        if not math.isfinite(self.level):
            raise FloatingPointError(f"the field is not finite after {self.steps} steps")
        self.peak = max(self.peak, self.level)
        for psi in (*self.psi_z, *self.psi_x):
            psi[np.abs(psi) < FLUSHED] = 0.0

    @property
    def residue(self) -> float:
        """Largest |u| as a share of the largest so far."""
        return self.level / self.peak if self.peak > 0.0 else 1.0

    def energy(self) -> float:
        """Return the electric plus magnetic energy at the present half-staggered instant, arbitrary unit (float64)."""
        total = 0.0
        for field, (_, drive) in ((self.u, self.at_u), (self.vx, self.at_vx), (self.vz, self.at_vz)):
            weight = self.params.courant / np.asarray(drive, np.float64)
            total += float(np.sum(np.square(field, dtype=np.float64) * weight))
        return total

    def _medium(self, permittivity: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients a and b of an E component with ghost rows, [nx + 2, nz]."""
        params = self.params
        shape = (params.cells_x, params.cells_z)
        eps = np.ones(shape, np.complex128) if permittivity is None else np.asarray(permittivity, np.complex128)
        if eps.shape != shape:
            raise ValueError(f"permittivity must have shape {shape}, got {eps.shape}")
        if not (np.all(eps.real >= 1.0) and np.all(eps.imag <= 0.0)):
            raise ValueError(f"permittivity needs Re >= 1 and Im <= 0, got Re {eps.real.min()}, Im {eps.imag.max()}")
        a, b = electric_coefficients(*real_medium(eps, params.frequency_hz), params.step_s)
        rows = np.clip(np.arange(params.cells_x + 2) - 1, 0, params.cells_x - 1)
        return a[rows].astype(params.dtype), (params.courant * b)[rows].astype(params.dtype)

    def _absorbers(
        self, position: np.ndarray, length: float, index: tuple[float, float] | None
    ) -> tuple[np.ndarray, ...]:
        """Return the decay, drive, 1/kappa at nodes, then at half positions; index None: no absorber."""
        params = self.params
        arrays: list[np.ndarray] = []
        for positions in (position, position + 0.5):
            if index is None:
                arrays += [np.zeros_like(positions), np.zeros_like(positions), np.ones_like(positions)]
                continue
            cells = params.absorber.cells
            ends = [
                layer(params.absorber, depth, params.cell_m, share, params.step_s, params.frequency_hz)
                for depth, share in zip((cells - positions, positions - (length - cells)), index, strict=True)
            ]
            arrays += [
                ends[0].decay + ends[1].decay,
                ends[0].drive + ends[1].drive,
                ends[0].inverse_kappa * ends[1].inverse_kappa,
            ]
        return tuple(array.astype(params.dtype) for array in arrays)


def _row(coefficient, i, near, far):  # type: ignore[no-untyped-def]
    """Return a coefficient of row i: one number, or its part of a map."""
    raise NotImplementedError


@overload(_row, inline="always")
def _row_overload(coefficient, i, near, far):  # type: ignore[no-untyped-def]
    if isinstance(coefficient, numba.types.Array):
        return lambda coefficient, i, near, far: coefficient[i, near:far]
    return lambda coefficient, i, near, far: coefficient


def _pick(row, k):  # type: ignore[no-untyped-def]
    """Return a coefficient at k, from one number or a row of a map."""
    raise NotImplementedError


@overload(_pick, inline="always")
def _pick_overload(row, k):  # type: ignore[no-untyped-def]
    if isinstance(row, numba.types.Array):
        return lambda row, k: row[k]
    return lambda row, k: row


# Rows are passed as vectors: the compiler then knows that no index is negative, and steps 8 or 16 nodes at a time.


@numba.njit(fastmath=True, cache=True)
def _step_slope(field, here, there, flat, a, b, sign):  # type: ignore[no-untyped-def]
    """Step a component in the plane: a field + sign b flat (there - here)."""
    for k in range(len(field)):
        slope = _pick(flat, k) * (there[k] - here[k])
        field[k] = _pick(a, k) * field[k] + sign * _pick(b, k) * slope


@numba.njit(fastmath=True, cache=True)
def _step_curl(field, x_here, x_before, z_here, z_before, flat_z, flat_x, a, b):  # type: ignore[no-untyped-def]
    """Step the component out of plane."""
    for k in range(len(field)):
        curl = flat_z[k] * (x_here[k] - x_before[k]) - flat_x * (z_here[k] - z_before[k])
        field[k] = _pick(a, k) * field[k] + _pick(b, k) * curl


@numba.njit(fastmath=True, cache=True)
def _absorb_slope(field, psi, here, there, decay, drive, b):  # type: ignore[no-untyped-def]
    """Step the memory of an absorber of x along a row, and take it from a field."""
    for k in range(len(field)):
        psi[k] = decay * psi[k] + drive * (there[k] - here[k])
        field[k] -= _pick(b, k) * psi[k]


@numba.njit(fastmath=True, cache=True)
def _step_v_row(p, i, u, vx, vz, at_vx, at_vz, along_z, along_x, psi_z, psi_x, near, far):  # type: ignore[no-untyped-def]
    """Step the two in-plane components of row i of part p from `near` to `far`."""
    _, _, _, decay_z, drive_z, flat_z = along_z
    _, _, _, decay_x, drive_x, flat_x = along_x
    nx, nz, cells, sides = u.shape[1] - 2, u.shape[2], psi_z.shape[2] // 2, psi_x.shape[1] // 2
    end, plus = min(far, nz - 1), u.dtype.type(1.0)
    ax, bx = _row(at_vx[0], i, near, end), _row(at_vx[1], i, near, end)
    az, bz = _row(at_vz[0], i, near, far), _row(at_vz[1], i, near, far)
    here, onward = u[p, i, near:far], u[p, i + 1, near:far]
    _step_slope(vx[p, i, near:end], u[p, i, near:end], u[p, i, near + 1 : end + 1], flat_z[near:end], ax, bx, plus)
    _step_slope(vz[p, i, near:far], here, onward, flat_x[i], az, bz, -plus)
    for j in range(2 * cells):
        k = j if j < cells else nz - 1 - 2 * cells + j
        if near <= k < far:
            psi_z[p, i, j] = decay_z[k] * psi_z[p, i, j] + drive_z[k] * (u[p, i, k + 1] - u[p, i, k])
            vx[p, i, k] += _pick(bx, k - near) * psi_z[p, i, j]
    if i <= sides or i > nx - sides:
        s = i - 1 if i <= sides else i - 1 - nx + 2 * sides
        _absorb_slope(vz[p, i, near:far], psi_x[p, s, near:far], here, onward, decay_x[i], drive_x[i], bz)


@numba.njit(fastmath=True, cache=True)
def _step_u_row(p, i, u, vx, vz, at_u, along_z, along_x, psi_z, psi_x, near, far):  # type: ignore[no-untyped-def]
    """Step the component out of plane of row i of part p; the outermost nodes of z stay zero."""
    decay_z, drive_z, flat_z, _, _, _ = along_z
    decay_x, drive_x, flat_x, _, _, _ = along_x
    nx, nz, cells, sides = u.shape[1] - 2, u.shape[2], psi_z.shape[2] // 2, psi_x.shape[1] // 2
    low, high = max(near, 1), min(far, nz - 1)
    a, b = _row(at_u[0], i, low, high), _row(at_u[1], i, low, high)
    field, here, before = u[p, i, low:high], vz[p, i, low:high], vz[p, i - 1, low:high]
    x_here, x_before = vx[p, i, low:high], vx[p, i, low - 1 : high - 1]
    _step_curl(field, x_here, x_before, here, before, flat_z[low:high], flat_x[i], a, b)
    for j in range(1, 2 * cells):
        k = j if j < cells else nz - 1 - 2 * cells + j
        if low <= k < high:
            psi_z[p, i, j] = decay_z[k] * psi_z[p, i, j] + drive_z[k] * (vx[p, i, k] - vx[p, i, k - 1])
            u[p, i, k] += _pick(b, k - low) * psi_z[p, i, j]
    if i <= sides or i > nx - sides:
        s = i - 1 if i <= sides else i - 1 - nx + 2 * sides
        _absorb_slope(field, psi_x[p, s, low:high], before, here, decay_x[i], drive_x[i], b)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _advance_v(u, vx, vz, at_vx, at_vz, along_z, along_x, psi_z, psi_x):  # type: ignore[no-untyped-def]
    """Step the two in-plane components, row by row."""
    parts, rows, nz = u.shape
    for row in numba.prange(parts * (rows - 2)):
        p, i = row // (rows - 2), row % (rows - 2) + 1
        _step_v_row(p, i, u, vx, vz, at_vx, at_vz, along_z, along_x, psi_z, psi_x, 0, nz)


@numba.njit(parallel=True, fastmath=True, cache=True)
def _advance_u(u, vx, vz, at_u, along_z, along_x, psi_z, psi_x):  # type: ignore[no-untyped-def]
    """Step the component out of plane, row by row."""
    parts, rows, nz = u.shape
    for row in numba.prange(parts * (rows - 2)):
        p, i = row // (rows - 2), row % (rows - 2) + 1
        _step_u_row(p, i, u, vx, vz, at_u, along_z, along_x, psi_z, psi_x, 0, nz)


@numba.njit(cache=True)
def _run(  # type: ignore[no-untyped-def]
    u,
    vx,
    vz,
    at_u,
    at_vx,
    at_vz,
    along_z,
    along_x,
    psi_z,
    psi_x,
    wrap,
    source,
    shape,
    rows,
    spectra,
    start,
    steps,
):
    """Run the steps: v, wrap, u, source, wrap, phasors."""
    cosine, sine, periodic = wrap
    row, phase, deviation = shape
    nx, k = u.shape[1] - 2, int(row)
    for step in range(start + 1, start + steps + 1):
        _advance_v(u, vx, vz, at_vx, at_vz, along_z, along_x, psi_z[0], psi_x[0])
        if periodic:
            _wrap(vz, 0, nx, cosine, sine)
        _advance_u(u, vx, vz, at_u, along_z, along_x, psi_z[1], psi_x[1])
        late = step - HALF_LENGTH * deviation
        if late < HALF_LENGTH * deviation:
            envelope = math.exp(-0.5 * (late / deviation) ** 2)
            odd, even = envelope * math.sin(phase * late), envelope * math.cos(phase * late)
            for i in range(nx):
                if periodic:
                    u[0, i + 1, k] += source[0, i] * odd
                    u[1, i + 1, k] += source[1, i] * odd
                else:
                    u[0, i + 1, k] += source[0, i] * odd + source[1, i] * even
        if periodic:
            _wrap(u, nx + 1, 1, cosine, -sine)
        turn = np.exp(-1j * phase * step)
        for r in range(len(rows)):
            for i in range(nx):
                spectra[r, i] += u[0, i + 1, rows[r]] * turn
                if periodic:
                    spectra[r, i] += u[1, i + 1, rows[r]] * (1j * turn)


@numba.njit(cache=True)
def _wrap(field, to, row, cosine, sine):  # type: ignore[no-untyped-def]
    """Set a row of both parts to another one, turned by the phase of a period."""
    # not by rows: expressions of arrays take seconds to compile
    for k in range(field.shape[2]):
        field[0, to, k] = cosine * field[0, row, k] - sine * field[1, row, k]
        field[1, to, k] = cosine * field[1, row, k] + sine * field[0, row, k]


@numba.njit(fastmath=True, cache=True)
def _run_node(  # type: ignore[no-untyped-def]
    u, vx, vz, at_u, at_vx, at_vz, along_z, along_x, psi_z, psi_x, part, node, drive, record
):
    """Take len(drive) steps of a part of the grid, several at a time.

    Row r of step t waits for row r + 1 of step t - 1 alone: steps follow each other two rows apart, and a row takes
    `SKEWED_STEPS` of them while it is in the cache.
    """
    low, high, near, far = part
    for first in range(0, len(drive), SKEWED_STEPS):
        count = min(SKEWED_STEPS, len(drive) - first)
        for front in range(low, high + 2 * (count - 1)):
            for t in range(count):
                row = front - 2 * t
                if row < low or row >= high:
                    continue
                i = row + 1
                _step_v_row(0, i, u, vx, vz, at_vx, at_vz, along_z, along_x, psi_z[0], psi_x[0], near, far)
                _step_u_row(0, i, u, vx, vz, at_u, along_z, along_x, psi_z[1], psi_x[1], near, far)
                if row == node[0]:
                    u[0, i, node[1]] += drive[first + t]
                    record[first + t] = u[0, i, node[1]]


@numba.njit(parallel=True, cache=True)
def _level_and_flush(u, vx, vz):  # type: ignore[no-untyped-def]
    """Return the largest |u|, or NaN; set values below `FLUSHED` to zero."""
    parts, rows, nz = u.shape
    levels = np.zeros(parts * rows)
    for row in numba.prange(parts * rows):
        p, i = row // rows, row % rows
        for k in range(nz):
            # NaN fails every comparison: it must not count as a field that has decayed
            if not abs(u[p, i, k]) <= levels[row]:
                levels[row] = abs(u[p, i, k])
            if math.isnan(levels[row]):
                break
            if abs(u[p, i, k]) < FLUSHED:
                u[p, i, k] = 0.0
            if abs(vx[p, i, k]) < FLUSHED:
                vx[p, i, k] = 0.0
            if abs(vz[p, i, k]) < FLUSHED:
                vz[p, i, k] = 0.0
    # not by numpy's reductions: they take seconds to compile
    largest = 0.0
    for level in levels:
        if not level <= largest:
            largest = level
        if math.isnan(largest):
            break
    return largest
