"""Randomly rough walls: a wide strip under a Bloch condition, its reflection sorted into Floquet orders.

The specular lobe is order zero; the other propagating orders carry the diffuse energy. Order m leaves along
k_par + 2 pi m / width. All wave numbers are those of the grid's own waves in air (discrete dispersion), which is also
how phases are carried from the probe row to the wall's mean plane; the incident wave comes from a run without the wall.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lab.full_wave.cpml import SPEED_OF_LIGHT_MPS, CpmlParams
from lab.full_wave.grid import Drive, GridParams, Media, YeeGrid
from lab.full_wave.media import Layers, checked_layers
from models.physics.fresnel import Polarisation

#: Cells between absorber, source row, probe row and the next part.
GAP_CELLS = 3
#: Sub-columns of a cell over which the surface's height is averaged.
SUB_COLUMNS = 4
#: A run ends when the field has fallen to this share of its peak, or after so many pulse lengths.
DECAY, MAX_PULSES = 1e-5, 10
#: Pulse: widest relative standard deviation, and distance to the cut-off (c k_par) in deviations.
WIDEST_SHARE, CUT_OFF_DEVIATIONS = 0.1, 5.0
#: Spectrum of heights is cut where k correlation = this: exp(-16) of its power is left out.
LAST_MODE = 8.0


@dataclass(frozen=True)
class RoughParams:
    """Settings of a wall's run: resolution, surface (roughness 0: smooth) and number type."""

    cells_per_wavelength: float = 20.0
    roughness_m: float = 0.0
    correlation_m: float = 0.03
    width_m: float | None = None
    seed: int = 0
    dtype: str = "float32"

    def __post_init__(self) -> None:
        if not self.cells_per_wavelength >= 4.0:
            raise ValueError(f"cells_per_wavelength must be at least 4, got {self.cells_per_wavelength!r}")
        if not (0.0 <= self.roughness_m < math.inf and 0.0 < self.correlation_m < math.inf):
            raise ValueError(
                f"roughness_m must be >= 0 and correlation_m > 0, got {self.roughness_m!r}, {self.correlation_m!r}"
            )
        if self.width_m is not None and not self.width_m > 0.0:
            raise ValueError(f"width_m must be positive, got {self.width_m!r}")


@dataclass(frozen=True)
class FloquetOrders:
    """Floquet orders of a strip: amplitudes of order zero, power shares of all propagating orders and their angles."""

    r: complex
    t: complex
    reflected_angle_rad: np.ndarray
    reflected: np.ndarray
    transmitted: np.ndarray
    cells: int
    steps: int
    residue: float


def rough_profile(width_m: float, roughness_m: float, correlation_m: float, seed: int, x_m: np.ndarray) -> np.ndarray:
    """Return the heights [m] at x of a periodic Gaussian surface with correlation exp(-x^2 / correlation^2).

    The same surface for any sampling. Each one is scaled to the wanted rms height exactly, its mean is zero.
    """
    rng = np.random.default_rng([seed, 0x5EED])
    modes = np.arange(1, max(2, math.ceil(LAST_MODE * width_m / (2.0 * math.pi * correlation_m))) + 1)
    wave_per_m = 2.0 * np.pi * modes / width_m
    weights = np.exp(-np.square(wave_per_m * correlation_m) / 8.0)
    coefficients = weights * (rng.standard_normal(len(modes)) + 1j * rng.standard_normal(len(modes)))
    coefficients *= roughness_m / math.sqrt(0.5 * float(np.sum(np.abs(coefficients) ** 2)))
    heights = np.zeros(np.shape(x_m))
    for wave, coefficient in zip(wave_per_m, coefficients, strict=True):
        heights += (coefficient * np.exp(1j * wave * np.asarray(x_m))).real
    return heights


def scatter(
    layers: Layers,
    angle_rad: float,
    frequency_hz: float,
    polarisation: Polarisation,
    params: RoughParams,
    on_step: Callable[[int, float], None] | None = None,
) -> FloquetOrders:
    """Reflect a plane wave from a wall whose front is rough; `on_step(steps, residue)` is called now and then."""
    layers = checked_layers(layers)
    if not 0.0 <= angle_rad <= math.radians(86.0):
        raise ValueError(f"angle_rad must lie in [0, 86 deg] for a wide strip, got {angle_rad!r}")
    if polarisation == "tm" and params.roughness_m > 0.0 and any(is_conductor(eps) for eps, _ in layers):
        raise ValueError("a rough good conductor is not to be had in tm: its stairs of cells guide waves; take te")
    strip = _Strip(layers, angle_rad, frequency_hz, polarisation, params)
    incident, _ = strip.run(None)
    spectra, grid = strip.run(strip.media(), on_step)
    return strip.orders(incident[0, 0], spectra, grid)


class _Strip:
    """Layout of one wide strip: rows of z, the grid's wave numbers, and the runs."""

    def __init__(
        self, layers: Layers, angle_rad: float, frequency_hz: float, polarisation: Polarisation, params: RoughParams
    ) -> None:
        wavelength_m = SPEED_OF_LIGHT_MPS / frequency_hz
        self.layers, self.rough, self.endless = layers, params, math.isinf(layers[-1][1])
        self.conductor = any(is_conductor(eps) for eps, _ in layers)
        self.cell_m = cell_size(layers, wavelength_m, params.cells_per_wavelength)
        least_m = max(12.0 * params.correlation_m, 8.0 * wavelength_m)
        wanted_m = params.width_m or quiet_width(least_m, math.sin(angle_rad), wavelength_m)
        cells_x = max(1, round(wanted_m / self.cell_m)) if params.roughness_m > 0.0 else 1
        self.width_m = cells_x * self.cell_m
        self.heights = self._heights(cells_x, 0.0)
        above, below = (math.ceil(side) for side in (-self.heights.min(), self.heights.max()))
        cosine = math.cos(angle_rad)
        absorber = CpmlParams(int(np.clip(0.5 * wavelength_m / (cosine * self.cell_m), 24, 200)), leak=1e-7)
        finite = [depth / self.cell_m for _, depth in layers if not math.isinf(depth)]
        if finite and below > finite[0] - 1.0:
            raise ValueError(f"roughness_m {params.roughness_m!r} pierces the first layer of {layers[0][1]!r} m")
        self.source = absorber.cells + GAP_CELLS
        self.probe = self.source + GAP_CELLS
        self.front = self.probe + GAP_CELLS + above + (0.0 if polarisation == "te" else 0.5)
        self.faces = self.front + np.concatenate([[0.0], np.cumsum(finite)])
        self.back = math.ceil(max(self.faces[-1], self.front + below)) + GAP_CELLS
        last = float(np.sqrt(layers[-1][0] - math.sin(angle_rad) ** 2).real) if self.endless else cosine
        self.grid = GridParams(
            cells_x,
            self.back + GAP_CELLS + absorber.cells,
            self.cell_m,
            frequency_hz,
            polarisation,
            0.0,
            (cosine, last),
            absorber,
            dtype=params.dtype,
        )
        self.air_per_m = self.grid.grid_wave_number
        self.along_per_m = self.grid.wave_number(self.air_per_m * math.sin(angle_rad))
        self.sine = math.sin(angle_rad)
        self.grid = replace(self.grid, bloch_rad=self.along_per_m * self.width_m)

    def media(self) -> Media:
        """Return the permittivity where the fields live; tangential and normal E take arithmetic and harmonic means."""
        if self.grid.polarisation == "te":
            return Media(out=self._mean(0.0, 0.0))
        return Media(along=self._mean(0.0, 0.5), normal=1.0 / self._mean(0.5, 0.0, inverse=True))

    def run(
        self, media: Media | None, on_step: Callable[[int, float], None] | None = None
    ) -> tuple[np.ndarray, YeeGrid]:
        """Return the phasors of u at the probe rows, complex128 [2, nx]; without media one column of air."""
        params = self.grid
        if media is None:
            index = (params.normal_index[0],) * 2
            params = replace(params, cells_x=1, bloch_rad=self.along_per_m * self.cell_m, normal_index=index)
        grid = YeeGrid(params, media or Media())
        share = min(WIDEST_SHARE, (1.0 - self.sine) / CUT_OFF_DEVIATIONS)
        profile = np.exp(-1j * self.along_per_m * self.cell_m * np.arange(params.cells_x))
        drive = Drive(self.source, profile, 1.0 / (share * params.phase_per_step))
        spectra = np.zeros((2, params.cells_x), np.complex128)
        while grid.steps < drive.steps or (grid.residue > DECAY and grid.steps < MAX_PULSES * drive.steps):
            grid.run(drive, (self.probe, self.back), 256, spectra)
            if on_step is not None:
                on_step(grid.steps, grid.residue)
        return spectra, grid

    def orders(self, incident: complex, spectra: np.ndarray, grid: YeeGrid) -> FloquetOrders:
        """Sort the fields at the probe rows into plane waves of the grid."""
        cells = self.grid.cells_x
        columns = np.arange(cells)
        phase = np.exp(1j * self.along_per_m * self.cell_m * columns)
        # [2, orders]: reflected, transmitted amplitudes at the probe rows per incident one
        waves = np.fft.fft(spectra * phase, axis=1) / (cells * incident)
        waves[0, 0] -= 1.0
        # bin m of the transform goes as exp(+2 pi j m x / W): order -m
        order = -np.fft.fftfreq(cells, 1.0 / cells)
        symbol = 2.0 / self.cell_m * np.sin(0.5 * self.cell_m * (self.along_per_m + 2.0 * np.pi * order / self.width_m))
        leaves = np.abs(symbol) < self.air_per_m * (1.0 - 1e-9)
        normal = np.sqrt(np.where(leaves, self.air_per_m**2 - symbol**2, 0.0))
        flux = np.sin(2.0 * np.arcsin(0.5 * self.cell_m * normal))
        power = np.abs(waves) ** 2 * flux / flux[0]
        depth_per_cell = self.grid.wave_number(normal[0]) * self.cell_m
        to_front = depth_per_cell * (self.front - self.probe)
        from_back = depth_per_cell * (self.back - self.faces[-1])
        return FloquetOrders(
            complex(waves[0, 0] * np.exp(2j * to_front)),
            0j if self.endless else complex(waves[1, 0] * np.exp(1j * (to_front + from_back))),
            np.arcsin(symbol[leaves] / self.air_per_m),
            power[0, leaves],
            np.zeros(0) if self.endless else power[1, leaves],
            self.grid.cells_x * self.grid.cells_z,
            grid.steps,
            grid.residue,
        )

    def _heights(self, cells_x: int, offset: float) -> np.ndarray:
        """Return the heights in cells, [nx, sub-columns], of the columns around (i + offset)."""
        if self.rough.roughness_m == 0.0:
            return np.zeros((cells_x, 1))
        inside = (np.arange(SUB_COLUMNS) + 0.5) / SUB_COLUMNS - 0.5
        x_m = (np.arange(cells_x)[:, None] + offset + inside) * self.cell_m
        rough = self.rough
        return rough_profile(self.width_m, rough.roughness_m, rough.correlation_m, rough.seed, x_m) / self.cell_m

    def _mean(self, offset_x: float, offset_z: float, inverse: bool = False) -> np.ndarray:
        """Return the mean of eps (or of 1 / eps) over the cells around (i + offset_x, k + offset_z), complex128 [nx,
        nz].
        """
        top = np.arange(self.grid.cells_z) + offset_z + 0.5
        values = [1.0 + 0j, *(eps for eps, _ in self.layers)] + ([] if self.endless else [1.0 + 0j])
        values = [1.0 / value for value in values] if inverse else values
        mean = np.full((self.grid.cells_x, self.grid.cells_z), values[0], np.complex128)
        for index, face in enumerate(self.faces):
            heights = self._heights(self.grid.cells_x, offset_x) if index == 0 else np.zeros((1, 1))
            share = sum(np.clip(top - face - column[:, None], 0.0, 1.0) for column in heights.T) / heights.shape[1]
            if self.conductor:
                # a partly metal cell would be a poor, lossy conductor: each cell is metal or not
                share = np.round(share)
            mean += (values[index + 1] - values[index]) * share
        return mean


def cell_size(layers: Layers, wavelength_m: float, cells_per_wavelength: float) -> float:
    """Return the cell [m] for so many a wavelength in the densest layer (good conductors apart), a whole number to
    layer one.
    """
    indices = [math.sqrt(eps.real) if is_conductor(eps) else np.sqrt(eps).real for eps, _ in layers]
    cell_m = wavelength_m / (cells_per_wavelength * max(indices))
    depth_m = layers[0][1]
    return cell_m if math.isinf(depth_m) else depth_m / math.ceil(depth_m / cell_m - 1e-9)


def quiet_width(least_m: float, sine: float, wavelength_m: float) -> float:
    """Return the width [m], up to a wavelength above the least, whose orders keep clear of grazing, where they ring
    for long.

    An order grazes where width (1 - sin) or width (1 + sin) is a whole number of wavelengths.
    """
    widths_m = least_m + wavelength_m * np.arange(64) / 64.0
    turns = np.outer([1.0 - sine, 1.0 + sine], widths_m) / wavelength_m
    clear = np.abs(turns - np.round(turns)).min(axis=0)
    return float(widths_m[clear.argmax()])


def is_conductor(permittivity: complex) -> bool:
    """Return whether the skin is too thin for square cells: loss above ten times the permittivity."""
    return -permittivity.imag > 10.0 * permittivity.real
