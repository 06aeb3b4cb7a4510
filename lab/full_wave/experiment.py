"""A beam on a wall in a finite domain: field picture, reflection and transmission read by detectors on both sides."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lab.full_wave.cpml import SPEED_OF_LIGHT_MPS, CpmlParams
from lab.full_wave.grid import Drive, GridParams, Media, YeeGrid
from lab.full_wave.media import Layers, checked_layers
from lab.full_wave.rough import cell_size
from models.physics.fresnel import Polarisation

#: Relative standard deviation of the pulse; a run ends at this share of the peak, or after so many batches.
PULSE_SHARE, DECAY, BATCH_STEPS, MAX_BATCHES = 0.1, 1e-7, 256, 400
#: Pictures add the field once in so many steps: at least this often a period.
PICTURES_A_PERIOD = 5.0


@dataclass(frozen=True)
class Experiment:
    """Layout of a transmission experiment; the wall spans the whole width and goes into the absorbers."""

    width_m: float = 0.9
    #: Beam: the field falls to 1/e at this distance from its axis.
    waist_m: float = 0.1
    #: Air before and behind the wall.
    before_m: float = 0.2
    behind_m: float = 0.1
    cells_per_wavelength: float = 10.0
    dtype: str = "float64"

    def __post_init__(self) -> None:
        if not 4.0 * self.waist_m <= self.width_m:
            raise ValueError(f"width_m must hold four waists of {self.waist_m!r} m, got {self.width_m!r}")


@dataclass(frozen=True)
class Transmission:
    """Detector readings and the field at the frequency of interest."""

    #: Power reflected and transmitted by the plane wave at the beam's angle [dB].
    reflection_db: float
    transmission_db: float
    #: Field out of plane as phasor per incident one on the axis at the front face, complex64 [x, z].
    field: np.ndarray
    #: Positions of the picture's rows and columns; the wall spans wall_m of z.
    x_m: np.ndarray
    z_m: np.ndarray
    wall_m: tuple[float, float]
    cells: int
    steps: int
    residue: float


def transmission_experiment(
    layers: Layers,
    frequency_hz: float,
    polarisation: Polarisation = "te",
    angle_rad: float = 0.0,
    experiment: Experiment | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> Transmission:
    """Send a beam at layers of finite thickness in a 2-D domain with CPML on all sides, with and without the wall.

    Detectors are rows of E (TE) or H (TM) before and behind the wall. A row summed with exp(+j k_par x) is the share of
    one plane wave of the beam, so R and T hold for that wave, whatever diffraction does to the beam. Its error is that
    of square cells, second order: at 10 cells about 1 dB in R and 5 % of T in dB; `reflect` is the finer answer.
    Raises ValueError for a half-space, bad media or an angle beyond 60 deg.
    """
    layers = checked_layers(layers)
    if math.isinf(layers[-1][1]):
        raise ValueError("a transmission experiment needs a last layer of finite thickness_m, got inf")
    if not abs(angle_rad) <= math.radians(60.0):
        raise ValueError(f"angle_rad must lie within 60 deg, the domain is finite, got {angle_rad!r}")
    bench = _Bench(layers, frequency_hz, polarisation, angle_rad, experiment or Experiment())
    incident, _, _ = bench.run(False, on_step)
    total, picture, grid = bench.run(True, on_step)
    reflected = bench.plane_wave(total[0] - incident[0]) / bench.plane_wave(incident[0])
    transmitted = bench.plane_wave(total[1]) / bench.plane_wave(incident[1])
    return Transmission(
        float(20.0 * np.log10(np.abs(reflected))),
        float(20.0 * np.log10(np.abs(transmitted))),
        (picture / np.abs(incident[2]).max()).astype(np.complex64),
        bench.x_m,
        bench.z_m,
        (bench.front * bench.cell_m, bench.back * bench.cell_m),
        picture.size,
        grid.steps,
        grid.residue,
    )


class _Bench:
    """Rows of the domain, its media and its runs."""

    def __init__(
        self, layers: Layers, frequency_hz: float, polarisation: Polarisation, angle_rad: float, setup: Experiment
    ) -> None:
        self.cell_m = cell_size(layers, SPEED_OF_LIGHT_MPS / frequency_hz, setup.cells_per_wavelength)
        self.layers, self.polarisation = layers, polarisation
        absorber = CpmlParams(cells=24, leak=1e-8)
        before, behind = (round(length_m / self.cell_m) for length_m in (setup.before_m, setup.behind_m))
        self.source = absorber.cells + 4
        self.front = self.source + before
        depths = np.cumsum([depth for _, depth in layers]) / self.cell_m
        self.faces = self.front + np.concatenate([[0.0], depths]) + (0.0 if polarisation == "te" else 0.5)
        self.back = self.front + math.ceil(depths[-1])
        self.params = GridParams(
            round(setup.width_m / self.cell_m),
            self.back + behind + absorber.cells,
            self.cell_m,
            frequency_hz,
            polarisation,
            None,
            (1.0, 1.0),
            absorber,
            dtype=setup.dtype,
        )
        self.x_m = (np.arange(self.params.cells_x) - 0.5 * (self.params.cells_x - 1)) * self.cell_m
        self.z_m = np.arange(self.params.cells_z) * self.cell_m
        self.along_per_m = self.params.wave_number(self.params.grid_wave_number * math.sin(angle_rad))
        # aimed so that the axis meets the front face in the middle
        aim_m = self.x_m + before * self.cell_m * math.tan(angle_rad)
        self.profile = np.exp(-np.square(aim_m / setup.waist_m) - 1j * self.along_per_m * self.x_m)
        self.rows = (self.source + before // 2, self.back + behind // 2, self.front)

    def run(self, wall: bool, on_step: Callable[[int, float], None] | None) -> tuple[np.ndarray, np.ndarray, YeeGrid]:
        """Return the phasors of u on the detector rows [3, nx] and everywhere [nx, nz], and the grid."""
        grid = YeeGrid(self.params, self._media() if wall else Media())
        drive = Drive(self.source, self.profile, 1.0 / (PULSE_SHARE * self.params.phase_per_step))
        every = max(1, int(2.0 * math.pi / (PICTURES_A_PERIOD * self.params.phase_per_step)))
        spectra = np.zeros((3, self.params.cells_x), np.complex128)
        picture = np.zeros((self.params.cells_x, self.params.cells_z), np.complex128)
        for _ in range(MAX_BATCHES):
            grid.run(drive, self.rows, BATCH_STEPS, spectra, picture if wall else None, every)
            if on_step is not None:
                on_step(grid.steps, grid.residue)
            if grid.steps > drive.steps and grid.residue < DECAY:
                break
        return spectra, picture * every, grid

    def plane_wave(self, row: np.ndarray) -> complex:
        """Return the share of the plane wave with k_par in a row of phasors."""
        return complex(np.sum(row * np.exp(1j * self.along_per_m * self.x_m)))

    def _media(self) -> Media:
        """Return the layers across the whole width."""
        shape = (self.params.cells_x, self.params.cells_z)

        def column(offset: float, inverse: bool = False) -> np.ndarray:
            values = [1.0 + 0j, *(eps for eps, _ in self.layers), 1.0 + 0j]
            values = [1.0 / value for value in values] if inverse else values
            top = np.arange(shape[1]) + offset + 0.5
            mean = np.full(shape[1], values[0])
            for before, after, face in zip(values[:-1], values[1:], self.faces, strict=True):
                mean = mean + (after - before) * np.clip(top - face, 0.0, 1.0)
            return np.broadcast_to(1.0 / mean if inverse else mean, shape)

        if self.polarisation == "te":
            return Media(out=column(0.0))
        return Media(along=column(0.5), normal=column(0.0, inverse=True))
