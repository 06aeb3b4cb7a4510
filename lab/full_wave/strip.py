"""Planar walls by FDTD: one column of Yee cells under a Bloch condition.

Every field varies as exp(-j k_par x) along the wall, so one column of cells, as narrow as one pleases, is enough:
d/dx is -j k_par. The out-of-phase component is carried as j times a real number, so all fields are real. Layer faces
lie on nodes of tangential E, whose permittivity is the mean over its cell; air cells span as much normal phase as those
of the finest layer. k_par is that of the grid's own wave in air at the wanted angle: (2/dt) sin(w dt/2) stands for w.
The reflected wave is the difference to a run without the wall, read at the front face itself, without propagation back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np

from lab.full_wave.cpml import SPEED_OF_LIGHT_MPS, CpmlParams, layer
from lab.full_wave.media import Layers, checked_layers, electric_coefficients, real_medium
from models.physics.fresnel import Polarisation

#: Cells of air between absorber and source, source and wall, and of the last medium before its absorber.
GAP_CELLS = 3
#: Absorber of both ends; kappa absorbs evanescent fields: the tails of waves guided by a slab.
ABSORBER = CpmlParams(kappa_max=8.0)
#: Courant number along the normal: near 1, where errors of space and time nearly cancel without loss.
COURANT = 0.99
#: Pulse: widest relative standard deviation, distance to the cut-off (c k_par) and half length in deviations.
WIDEST_SHARE, CUT_OFF_DEVIATIONS, HALF_LENGTH_DEVIATIONS = 0.08, 6.0, 6.0
#: A run ends when the field has fallen to this share of its peak, or after so many pulse lengths.
DECAY, MAX_PULSES = 1e-6, 40


@dataclass(frozen=True)
class StripParams:
    """Settings of a planar run."""

    cells_per_wavelength: float = 20.0
    courant: float = COURANT
    dtype: str = "float64"

    def __post_init__(self) -> None:
        if not self.cells_per_wavelength >= 4.0:
            raise ValueError(f"cells_per_wavelength must be at least 4, got {self.cells_per_wavelength!r}")
        if not 0.0 < self.courant <= 1.0:
            raise ValueError(f"courant must lie in (0, 1], the stability limit, got {self.courant!r}")
        if self.dtype not in ("float32", "float64"):
            raise ValueError(f"dtype must be float32 or float64, got {self.dtype!r}")


@dataclass(frozen=True)
class Strip:
    """A column: cell sizes and media per cell, nodes of source and faces, time step; [cells] float64 arrays."""

    cell_m: np.ndarray
    eps_r: np.ndarray
    sigma_s_per_m: np.ndarray
    source: int
    front: int
    back: int
    step_s: float
    transverse_per_m: float
    absorbed_index: tuple[float, float]

    def __post_init__(self) -> None:
        limit_s = courant_limit_s(self.cell_m, self.eps_r, self.transverse_per_m)
        if self.step_s > limit_s:
            raise ValueError(f"step_s {self.step_s!r} is above the Courant limit {limit_s!r}")


@dataclass(frozen=True)
class Phasors:
    """Tangential E at the front and back faces at the frequency of interest, and the cost of the run."""

    front: complex
    back: complex
    cells: int
    steps: int
    residue: float


def courant_limit_s(cell_m: np.ndarray, eps_r: np.ndarray, transverse_per_m: float) -> float:
    """Return the longest stable time step of a column: c dt sqrt(1/h^2 + (k_par/2)^2) <= sqrt(eps_r) in every cell."""
    rate = np.sqrt((1.0 / np.square(cell_m) + (0.5 * transverse_per_m) ** 2) / eps_r)
    return float(1.0 / (SPEED_OF_LIGHT_MPS * rate.max()))


def build_strips(layers: Layers, angle_rad: float, frequency_hz: float, params: StripParams) -> tuple[Strip, Strip]:
    """Return the column with the wall and the one of air alone, on the same air cells and time step."""
    layers = checked_layers(layers)
    sine, cosine = math.sin(angle_rad), math.cos(angle_rad)
    if not (0.0 <= angle_rad < 0.5 * math.pi and cosine > 1e-4):
        raise ValueError(f"angle_rad must lie in [0, pi/2), got {angle_rad!r}")
    wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
    indices = [np.sqrt(eps - sine**2) for eps, _ in layers]
    media = [(float(eps_r), float(sigma)) for eps_r, sigma in (real_medium(eps, frequency_hz) for eps, _ in layers)]
    finest = [wavelength_m / (params.cells_per_wavelength * np.sqrt(eps).real) for eps, _ in layers]
    counts = [
        ABSORBER.cells + GAP_CELLS if math.isinf(depth) else math.ceil(depth / cell - 1e-9)
        for cell, (_, depth) in zip(finest, layers, strict=True)
    ]
    sizes = [
        cell if math.isinf(depth) else depth / count
        for cell, count, (_, depth) in zip(finest, counts, layers, strict=True)
    ]
    normal = min(size * index.real for size, index in zip(sizes, indices, strict=True))
    reach = [size * math.sqrt(eps_r - sine**2) for size, (eps_r, _) in zip(sizes, media, strict=True)]
    step_s = params.courant * min(normal, *reach) / SPEED_OF_LIGHT_MPS
    air = (normal / cosine, 1.0, 0.0)
    open_end = ABSORBER.cells + GAP_CELLS
    front = open_end + GAP_CELLS
    wall = [(size, *medium) for size, medium, count in zip(sizes, media, counts, strict=True) for _ in range(count)]
    endless = math.isinf(layers[-1][1])
    behind = [] if endless else [air] * open_end
    transverse = 2.0 / (step_s * SPEED_OF_LIGHT_MPS) * math.sin(math.pi * frequency_hz * step_s) * sine
    last = float(indices[-1].real) if endless else cosine

    def column(cells: list[tuple[float, float, float]], back: int, end: float) -> Strip:
        cell_m, eps_r, sigma = np.array(cells).T
        return Strip(cell_m, eps_r, sigma, open_end, front, back, step_s, transverse, (cosine, end))

    back = front if endless else front + len(wall)
    return column([air] * front + wall + behind, back, last), column([air] * (front + open_end), front, cosine)


def run_strip(strip: Strip, frequency_hz: float, polarisation: Polarisation, params: StripParams) -> Phasors:
    """Step a column until the pulse has left and take the phasors of tangential E at its faces."""
    cells = len(strip.cell_m)
    dtype = np.dtype(params.dtype)
    reach_m = SPEED_OF_LIGHT_MPS * strip.step_s
    dual_m = np.empty(cells + 1)
    dual_m[1:-1] = 0.5 * (strip.cell_m[1:] + strip.cell_m[:-1])
    dual_m[[0, -1]] = strip.cell_m[[0, -1]]
    at_nodes = electric_coefficients(
        _node_mean(strip.eps_r, strip.cell_m), _node_mean(strip.sigma_s_per_m, strip.cell_m), strip.step_s
    )
    at_cells = electric_coefficients(strip.eps_r, strip.sigma_s_per_m, strip.step_s)
    node_layer = _absorbers(strip, np.arange(cells + 1.0), frequency_hz)
    cell_layer = _absorbers(strip, np.arange(cells) + 0.5, frequency_hz)
    arrays = (*at_nodes, *at_cells, reach_m / dual_m, reach_m / strip.cell_m, *node_layer, *cell_layer)
    sine = strip.transverse_per_m * reach_m / (2.0 * math.sin(math.pi * frequency_hz * strip.step_s))
    deviation_hz = frequency_hz * min(WIDEST_SHARE, (1.0 - sine) / CUT_OFF_DEVIATIONS)
    deviation_steps = 1.0 / (2.0 * math.pi * deviation_hz * strip.step_s)
    front, back, steps, residue = _advance(
        tuple(array.astype(dtype) for array in arrays),
        polarisation == "te",
        dtype.type(strip.transverse_per_m * reach_m),
        np.array([strip.source, strip.front, strip.back]),
        2.0 * math.pi * frequency_hz * strip.step_s,
        deviation_steps,
        DECAY,
    )
    # an overflowed field leaves a residue of -1 / inf, which is not below zero: test the result too
    if not (0.0 <= residue < math.inf and np.isfinite([front, back]).all()):
        raise FloatingPointError(f"the field is not finite after {steps} steps")
    return Phasors(front, back, cells, steps, residue)


def _node_mean(per_cell: np.ndarray, cell_m: np.ndarray) -> np.ndarray:
    """Return the mean over the cell around each node: tangential E is continuous, so its permittivities add by
    length.
    """
    mean = np.empty(len(per_cell) + 1)
    mean[0], mean[-1] = per_cell[0], per_cell[-1]
    weighted = per_cell * cell_m
    mean[1:-1] = (weighted[1:] + weighted[:-1]) / (cell_m[1:] + cell_m[:-1])
    return mean


def _absorbers(strip: Strip, position: np.ndarray, frequency_hz: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the decay, drive and 1/kappa of both ends at positions counted in cells."""
    low = layer(
        ABSORBER, ABSORBER.cells - position, float(strip.cell_m[0]), strip.absorbed_index[0], strip.step_s, frequency_hz
    )
    high = layer(
        ABSORBER,
        position - (len(strip.cell_m) - ABSORBER.cells),
        float(strip.cell_m[-1]),
        strip.absorbed_index[1],
        strip.step_s,
        frequency_hz,
    )
    return low.decay + high.decay, low.drive + high.drive, low.inverse_kappa * high.inverse_kappa


@numba.njit(cache=True, fastmath=True, nogil=True)
def _advance(coefficients, is_te, transverse, nodes, phase_per_step, deviation_steps, decay):  # type: ignore[no-untyped-def]
    """Step E along the wall at nodes, H between them, and the field along the normal (times j): of TE H, at nodes."""
    a, per_cell = coefficients[0], coefficients[5]
    e, h, normal = np.zeros_like(a), np.zeros_like(per_cell), np.zeros_like(a if is_te else per_cell)
    psi_e, psi_h = np.zeros_like(a), np.zeros_like(per_cell)
    front, back, peak, residue = 0j, 0j, 0.0, 1.0
    least, max_steps = _run_length(deviation_steps)
    step = 0
    while step < max_steps:
        if is_te:
            _step_te(coefficients, transverse, e, h, normal, psi_e, psi_h)
        else:
            _step_tm(coefficients, transverse, e, h, normal, psi_e, psi_h)
        step += 1
        e[nodes[0]] += _pulse(step, phase_per_step, deviation_steps)
        turn = np.exp(-1j * phase_per_step * step)
        front += e[nodes[1]] * turn
        back += e[nodes[2]] * turn
        if step % 64 == 0:
            level = _level_and_flush(e, h, normal, psi_e, psi_h)
            peak = max(peak, level)
            residue = level / max(peak, 1e-30)
            if level < 0.0 or (step > least and residue < decay):
                break
    return front, back, step, residue


@numba.njit(cache=True, fastmath=True, nogil=True)
def _step_te(coefficients, transverse, e, h, normal, psi_e, psi_h):  # type: ignore[no-untyped-def]
    """TE: E along the wall's vertical; H along the wall."""
    a, b, _, _, per_dual, per_cell, node_b, node_c, node_k, cell_b, cell_c, cell_k = coefficients
    cells = len(per_cell)
    for k in range(cells):
        slope = (e[k + 1] - e[k]) * per_cell[k]
        psi_h[k] = cell_b[k] * psi_h[k] + cell_c[k] * slope
        h[k] += slope * cell_k[k] + psi_h[k]
    for k in range(cells + 1):
        normal[k] += transverse * e[k]
    for k in range(1, cells):
        slope = (h[k] - h[k - 1]) * per_dual[k]
        psi_e[k] = node_b[k] * psi_e[k] + node_c[k] * slope
        e[k] = a[k] * e[k] + b[k] * (slope * node_k[k] + psi_e[k] - transverse * normal[k])


@numba.njit(cache=True, fastmath=True, nogil=True)
def _step_tm(coefficients, transverse, e, h, normal, psi_e, psi_h):  # type: ignore[no-untyped-def]
    """TM: E along the wall; H along its vertical."""
    a, b, cell_a, cell_e, per_dual, per_cell, node_b, node_c, node_k, cell_b, cell_c, cell_k = coefficients
    cells = len(per_cell)
    for k in range(cells):
        slope = (e[k + 1] - e[k]) * per_cell[k]
        psi_h[k] = cell_b[k] * psi_h[k] + cell_c[k] * slope
        h[k] += transverse * normal[k] - slope * cell_k[k] - psi_h[k]
        normal[k] = cell_a[k] * normal[k] - cell_e[k] * transverse * h[k]
    for k in range(1, cells):
        slope = (h[k] - h[k - 1]) * per_dual[k]
        psi_e[k] = node_b[k] * psi_e[k] + node_c[k] * slope
        e[k] = a[k] * e[k] - b[k] * (slope * node_k[k] + psi_e[k])


@numba.njit(cache=True, inline="always")
def _run_length(deviation_steps):  # type: ignore[no-untyped-def]
    """Return the steps of the pulse, and the largest number of steps of a run."""
    length = int(2.0 * HALF_LENGTH_DEVIATIONS * deviation_steps)
    return length, MAX_PULSES * length


@numba.njit(cache=True, inline="always")
def _pulse(step, phase_per_step, deviation_steps):  # type: ignore[no-untyped-def]
    """Return a Gaussian pulse on the carrier, odd about its middle: a DC part would leave static charge."""
    late = step - HALF_LENGTH_DEVIATIONS * deviation_steps
    if late > HALF_LENGTH_DEVIATIONS * deviation_steps:
        return 0.0
    return math.exp(-0.5 * (late / deviation_steps) ** 2) * math.sin(phase_per_step * late)


@numba.njit(cache=True)
def _level_and_flush(e, h, normal, psi_e, psi_h):  # type: ignore[no-untyped-def]
    """Return the largest |E|, or -1 for NaN; set values below 1e-30 to zero, before subnormal numbers slow the
    steps.
    """
    level = 0.0
    for value in e:
        if math.isnan(value):
            return -1.0
        level = max(level, abs(value))
    for array in (e, h, normal, psi_e, psi_h):
        for k in range(len(array)):
            if abs(array[k]) < 1e-30:
                array[k] = 0.0
    return level
