"""Radar values: parameters, grids, and the messages that carry beams and range-azimuth maps."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from msgs.values.arrays import (
    MAX_STAMP_NS,
    Array,
    AzimuthRad,
    Checked,
    Count,
    LevelDb,
    Metres,
    Share,
    StampNs,
    StandardDeviation,
    require_finite,
    require_within,
)
from msgs.values.frames import Pose2
from msgs.values.units import BOLTZMANN_J_PER_K, REFERENCE_TEMPERATURE_K, SPEED_OF_LIGHT_MPS, ns_from_s, ratio_from_db

#: Magnitude of the int16 code that `full_scale_dbm` refers to.
FULL_SCALE_CODE = 32768
#: Permitted range of each parameter, ends included. Far beyond any device; within them memory and time are bounded,
#: and every quantity is a finite double.
RADAR_LIMITS: dict[str, tuple[float, float]] = {
    "carrier_hz": (1e6, 1e15),
    "bandwidth_hz": (1.0, 1e13),
    "sample_rate_hz": (1.0, 1e13),
    "chirps_per_beam": (1, 1 << 14),
    "samples_per_chirp": (1, 1 << 20),
    "transmit_power_w": (1e-30, 1e12),
    "noise_figure_db": (-200.0, 200.0),
    "scan_period_s": (1e-9, 1e6),
}
ARRAY_LIMITS: dict[str, tuple[float, float]] = {"columns": (1, 256), "rows": (1, 1 << 12)}
SPACING_LIMITS_M = (1e-9, 1e3)
RANGE_BIN_LIMITS_M = (1e-9, 1e9)
#: Without a limit: the same in all directions.
BEAM_WIDTH_LIMITS_DEG = (1e-3, math.inf)
MAX_BEAMS = 1024
#: In both directions.
MAX_LEVEL_DB = 300.0
LONGEST_CHIRP_INTERVAL_S = 1e3


def amplitude_per_code(full_scale_dbm: float) -> float:
    """Return amplitude [sqrt(mW)] of one int16 code, where a complex tone of amplitude 32768 has `full_scale_dbm`."""
    return math.sqrt(ratio_from_db(full_scale_dbm)) / FULL_SCALE_CODE


class RadarParams(msgspec.Struct, frozen=True, kw_only=True):
    """Waveform, timing and receiver of an FMCW radar; defaults are Table 1 and section 2.1.1 (X-band)."""

    carrier_hz: float = 10e9
    bandwidth_hz: float = 700e6
    sample_rate_hz: float = 1.5e9
    chirps_per_beam: int = 128
    samples_per_chirp: int = 8192
    transmit_power_w: float = 1.6e-3
    noise_figure_db: float = 8.0
    #: Time from the first beam of a scan to the first beam of the next; beams are spread evenly over it.
    scan_period_s: float = 0.3
    #: From the first sample of a chirp to that of the next; None: chirps follow without a gap.
    chirp_interval_s: float | None = None

    def __post_init__(self) -> None:
        for name, limits in RADAR_LIMITS.items():
            require_within(f"radar.{name}", *limits, getattr(self, name))
        if self.bandwidth_hz >= 2.0 * self.carrier_hz:
            rule = f"radar.bandwidth_hz must be below twice radar.carrier_hz, {self.carrier_hz!r}"
            raise ValueError(f"{rule}, got {self.bandwidth_hz!r}")
        if (
            self.chirp_interval_s is not None
            and not self.chirp_period_s <= self.chirp_interval_s <= LONGEST_CHIRP_INTERVAL_S
        ):
            raise ValueError(
                "radar.chirp_interval_s must be finite and no shorter than a chirp's samples, "
                f"{self.chirp_period_s!r} s, nor longer than {LONGEST_CHIRP_INTERVAL_S:g} s, "
                f"got {self.chirp_interval_s!r}"
            )

    @property
    def wavelength_m(self) -> float:
        """Carrier wavelength in metres."""
        return SPEED_OF_LIGHT_MPS / self.carrier_hz

    @property
    def chirp_period_s(self) -> float:
        """T_c = N / (f_s N_c), Table 1."""
        return self.samples_per_chirp / self.sample_rate_hz

    @property
    def chirp_slope_hz_per_s(self) -> float:
        """S = B / T_c, Table 1."""
        return self.bandwidth_hz / self.chirp_period_s

    @property
    def repetition_interval_s(self) -> float:
        """Time from one chirp to the next: T_c unless the radar rests in between."""
        return self.chirp_period_s if self.chirp_interval_s is None else self.chirp_interval_s

    @property
    def beam_duration_s(self) -> float:
        """T_f = N_c T_c, Table 1: time that one beam takes, rests between chirps included."""
        return self.chirps_per_beam * self.repetition_interval_s

    @property
    def range_bin_m(self) -> float:
        """c / 2B: range spacing of the chirp-length FFT."""
        return SPEED_OF_LIGHT_MPS / (2.0 * self.bandwidth_hz)

    @property
    def noise_power_mw(self) -> float:
        """k T0 f_s F: total receiver noise power over the sampled band, in milliwatt."""
        watt = BOLTZMANN_J_PER_K * REFERENCE_TEMPERATURE_K * self.sample_rate_hz * ratio_from_db(self.noise_figure_db)
        return 1e3 * watt


class ArrayParams(msgspec.Struct, frozen=True, kw_only=True):
    """A uniform planar array steered in azimuth by phase shifters (section 2.1.1: 4 x 8, 6 bits)."""

    columns: int = 8
    rows: int = 4
    #: None: half a wavelength.
    column_spacing_m: float | None = None
    row_spacing_m: float | None = None
    #: 0: ideal, unquantised phases.
    phase_bits: int = 6
    #: Phases are rounded as counted from the middle of the array, so that beams to left and right are mirrored; False:
    #: from the first column on.
    phases_from_centre: bool = False
    #: 2: transmit and receive are steered alike; 1: receive alone, the transmitter is one fixed element.
    steered_ways: int = 2
    #: The receiver samples all columns at once, and beams are formed digitally from those samples: all beams of a scan
    #: have the same time. Needs `steered_ways` 1 and no phase shifters.
    digital: bool = False

    def __post_init__(self) -> None:
        for name, limits in ARRAY_LIMITS.items():
            require_within(f"array.{name}", *limits, getattr(self, name))
        for name in ("column_spacing_m", "row_spacing_m"):
            if getattr(self, name) is not None:
                require_within(f"array.{name}", *SPACING_LIMITS_M, getattr(self, name))
        if not 0 <= self.phase_bits <= 16:
            raise ValueError(f"array.phase_bits must be 0..16, got {self.phase_bits!r}")
        if self.steered_ways not in (1, 2):
            raise ValueError(f"array.steered_ways must be 1 or 2, got {self.steered_ways!r}")
        if self.digital and (self.steered_ways, self.phase_bits) != (1, 0):
            raise ValueError(
                "array.digital needs array.steered_ways 1 and array.phase_bits 0, "
                f"got {self.steered_ways!r} and {self.phase_bits!r}"
            )

    def column_spacing(self, wavelength_m: float) -> float:
        """Return column spacing in metres, lambda/2 unless given."""
        return wavelength_m / 2.0 if self.column_spacing_m is None else self.column_spacing_m

    def row_spacing(self, wavelength_m: float) -> float:
        """Return row spacing in metres, lambda/2 unless given."""
        return wavelength_m / 2.0 if self.row_spacing_m is None else self.row_spacing_m


class ElementPattern(msgspec.Struct, frozen=True, kw_only=True):
    """Element pattern of section 2.1.1: Gaussian main lobe, floor, nothing backward."""

    azimuth_hpbw_deg: float = 80.0
    elevation_hpbw_deg: float = 60.0
    peak_gain_dbi: float = 4.1
    sidelobe_floor_db: float = -25.0

    def __post_init__(self) -> None:
        for name in ("azimuth_hpbw_deg", "elevation_hpbw_deg"):
            require_within(f"element.{name}", *BEAM_WIDTH_LIMITS_DEG, getattr(self, name))
        for name in ("peak_gain_dbi", "sidelobe_floor_db"):
            require_within(f"element.{name}", -MAX_LEVEL_DB, MAX_LEVEL_DB, getattr(self, name))


class BeamGrid(msgspec.Struct, frozen=True, kw_only=True):
    """Steering azimuths of a scan in order of acquisition; 25 beams, -60..60 deg by 5, unless given."""

    azimuth_deg: tuple[float, ...] = tuple(float(angle) for angle in range(-60, 61, 5))

    def __post_init__(self) -> None:
        if not self.azimuth_deg:
            raise ValueError("beams.azimuth_deg must name at least one beam")
        if len(self.azimuth_deg) > MAX_BEAMS:
            raise ValueError(f"beams.azimuth_deg must name at most {MAX_BEAMS} beams, got {len(self.azimuth_deg)}")
        require_finite("beams.azimuth_deg", *self.azimuth_deg)
        if max(abs(angle) for angle in self.azimuth_deg) >= 90.0:
            raise ValueError(f"beams.azimuth_deg must lie inside -90..90, got {self.azimuth_deg}")

    @property
    def azimuth_rad(self) -> np.ndarray:
        """Steering azimuths in radians, [beams]."""
        return np.radians(self.azimuth_deg)

    def __len__(self) -> int:
        return len(self.azimuth_deg)


class RangeAzimuthGrid(msgspec.Struct, frozen=True, kw_only=True):
    """Cells of a range-azimuth map: bin i at i * range_bin_m, azimuths uniform in degree over +-limit."""

    range_bin_m: float = SPEED_OF_LIGHT_MPS / (2.0 * 700e6)
    range_bins: int = 512
    azimuth_bins: int = 256
    azimuth_limit_deg: float = 60.0

    def __post_init__(self) -> None:
        require_within("grid.range_bin_m", *RANGE_BIN_LIMITS_M, self.range_bin_m)
        if not 1 <= self.range_bins <= 8192:
            raise ValueError(f"grid.range_bins must be 1..8192, got {self.range_bins!r}")
        if not 2 <= self.azimuth_bins <= 4096:
            raise ValueError(f"grid.azimuth_bins must be 2..4096, got {self.azimuth_bins!r}")
        if not 0.0 < self.azimuth_limit_deg <= 90.0:
            raise ValueError(f"grid.azimuth_limit_deg must be in (0, 90], got {self.azimuth_limit_deg!r}")

    @property
    def shape(self) -> tuple[int, int]:
        """(range bins, azimuth bins)."""
        return self.range_bins, self.azimuth_bins

    @property
    def azimuth_step_rad(self) -> float:
        """Spacing of neighbouring azimuths."""
        return math.radians(2.0 * self.azimuth_limit_deg / (self.azimuth_bins - 1))

    @property
    def range_m(self) -> np.ndarray:
        """Centres of the range bins, [range]."""
        return self.range_bin_m * np.arange(self.range_bins)

    @property
    def azimuth_rad(self) -> np.ndarray:
        """Centres of the azimuth bins, [azimuth]."""
        limit_rad = math.radians(self.azimuth_limit_deg)
        return np.linspace(-limit_rad, limit_rad, self.azimuth_bins)

    def range_index(self, range_m: np.ndarray) -> np.ndarray:
        """Return the fractional range bin of ranges in metres."""
        return np.asarray(range_m) / self.range_bin_m

    def azimuth_index(self, azimuth_rad: np.ndarray) -> np.ndarray:
        """Return the fractional azimuth bin of azimuths in radians."""
        return (np.asarray(azimuth_rad) + math.radians(self.azimuth_limit_deg)) / self.azimuth_step_rad

    def range_at(self, index: np.ndarray) -> np.ndarray:
        """Return range in metres of fractional bins."""
        return np.asarray(index) * self.range_bin_m

    def azimuth_at(self, index: np.ndarray) -> np.ndarray:
        """Return azimuth in radians of fractional bins."""
        return np.asarray(index) * self.azimuth_step_rad - math.radians(self.azimuth_limit_deg)


class RadarSetup(Checked, frozen=True, kw_only=True, eq=False):
    """Set-up that a receiver needs before the first beam: radar, array, beams, calibration (topic `radar/setup`)."""

    label: ClassVar[str] = "setup"

    stamp_ns: StampNs = 0
    radar: RadarParams = RadarParams()
    array: ArrayParams = ArrayParams()
    element: ElementPattern = ElementPattern()
    beams: BeamGrid = BeamGrid()
    #: Power of a complex tone of amplitude 32768.
    full_scale_dbm: LevelDb = -20.0
    #: +1 where beats have positive frequency for positive range, -1 where the hardware differs.
    beat_sign: int = 1
    radar_height_m: Metres = 1.0
    #: Steering weights of the columns, complex64 [beams, columns]; None: computed from `array` and `beams`.
    steering_weights: Annotated[np.ndarray, Array("<c8", ("beams", "array.columns"))] | None = None
    #: Place on the vehicle where the source knows it; None: it does not.
    vehicle_from_radar: Pose2 | None = None
    #: Open-field background, one chirp a beam, complex64 [beams, samples] in units of the int16 codes.
    background: Annotated[np.ndarray, Array("<c8", ("beams", "radar.samples_per_chirp"))] | None = None

    @property
    def map_grid(self) -> RangeAzimuthGrid:
        """The grid of its maps: the default one in its own range bins, no more of them than a chirp has samples."""
        bins = min(RangeAzimuthGrid().range_bins, self.radar.samples_per_chirp)
        return RangeAzimuthGrid(range_bin_m=self.radar.range_bin_m, range_bins=bins)

    @property
    def scan_bytes(self) -> int:
        """Bytes of the samples of one scan, int16 I and Q."""
        return 4 * len(self.beams) * self.radar.chirps_per_beam * self.radar.samples_per_chirp

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.beat_sign not in (1, -1):
            raise ValueError(f"setup.beat_sign must be +1 or -1, got {self.beat_sign!r}")

    @property
    def beam_interval_ns(self) -> int:
        """Nominal time from one beam to the next; 0 for a digital array, whose beams have the same time."""
        return 0 if self.array.digital else self.beam_share_ns

    @property
    def beam_share_ns(self) -> int:
        """A beam's share of the scan period."""
        return ns_from_s(self.radar.scan_period_s / len(self.beams))

    @property
    def milliwatt_per_code_squared(self) -> float:
        """Power in milliwatt of a complex tone of amplitude one code."""
        return amplitude_per_code(self.full_scale_dbm) ** 2


def orthogonal_beams(columns: int) -> BeamGrid:
    """Return the beams of a digital array of half-wavelength columns: sines 2 / columns apart, noise independent."""
    sines = 2.0 / columns * (np.arange(columns) - 0.5 * (columns - 1))
    return BeamGrid(azimuth_deg=tuple(np.degrees(np.arcsin(sines)).tolist()))


#: Radars by name. The 77 GHz one has the aperture of section 2.1.1, a single row of 57, received digitally.
PRESETS: dict[str, RadarSetup] = {
    "xband": RadarSetup(array=ArrayParams(phases_from_centre=True)),
    "77ghz": RadarSetup(
        radar=RadarParams(carrier_hz=77e9),
        array=ArrayParams(columns=57, rows=1, phase_bits=0, steered_ways=1, digital=True),
        beams=orthogonal_beams(57),
    ),
}


class RadarBeam(Checked, frozen=True, kw_only=True, eq=False):
    """Raw beat samples of one steering angle (topic `radar/beam`)."""

    label: ClassVar[str] = "beam"

    stamp_ns: StampNs
    scan_id: Count
    beam_index: Count
    beam_count: Annotated[int, msgspec.Meta(ge=1, le=MAX_BEAMS)]
    azimuth_rad: AzimuthRad
    #: I and Q codes, int16 [chirps, samples, 2].
    samples: Annotated[np.ndarray, Array("<i2", (None, None, 2))]
    full_scale_dbm: LevelDb

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.beam_index < self.beam_count:
            raise ValueError(f"beam.beam_index must be 0..beam_count-1, got {self.beam_index!r} of {self.beam_count!r}")


#: Profiles and azimuths coherent; profiles alone, azimuths from magnitudes; mean power of single chirps.
FORMING_MODES = ("coherent", "magnitude", "welch")
#: Origin of a map: formed of beams, or excess photons of a LiDAR in standard deviations.
MAP_MODES = (*FORMING_MODES, "photons")
#: Faults of the receiver's wiring and of its converters, in words.
WIRING_FAULTS = {
    "i_stuck": "I does not change",
    "q_stuck": "Q does not change",
    "i_equals_q": "I and Q carry the same signal",
    "iq_exchanged": "echoes stand at negative ranges: I and Q are exchanged, or beat_sign is wrong",
    "i_bit_stuck": "a bit of I does not change while higher and lower ones do",
    "q_bit_stuck": "a bit of Q does not change while higher and lower ones do",
}
#: Zeroed chirps; beams without any echo; beams with foreign noise; tones that fill all beams; columns whose gains or
#: phases are not those of the set-up; and those of the wiring.
MAP_FAULTS = ("lost_chirps", "silent_beams", "drowned_beams", "spurs", "array_error", *WIRING_FAULTS)


#: Code of a cell whose radial speed is not known.
NO_RADIAL_SPEED = -(1 << 15)


def speed_codes(speed_mps: np.ndarray) -> np.ndarray:
    """Return radial speeds in cm/s, those beyond int16 at its ends, `NO_RADIAL_SPEED` where they are NaN; int16."""
    speed_cmps = np.rint(100.0 * np.nan_to_num(speed_mps))
    codes = np.clip(speed_cmps, NO_RADIAL_SPEED + 1, -NO_RADIAL_SPEED - 1)
    return np.where(np.isnan(speed_mps), NO_RADIAL_SPEED, codes).astype(np.int16)


def mps_from_speed_codes(codes: np.ndarray) -> np.ndarray:
    """Return the radial speeds that `speed_codes` wrote, m/s, NaN where there is none; float64."""
    return np.where(codes == NO_RADIAL_SPEED, np.nan, 0.01 * codes)


class RangeAzimuthMap(Checked, frozen=True, kw_only=True, eq=False):
    """Complex range-azimuth map of one scan (topic `radar/ra_map`); |values|^2 is milliwatt per bin."""

    label: ClassVar[str] = "map"

    #: Acquisition of the first beam; positions in the map refer to the radar's pose at this time.
    stamp_ns: StampNs
    scan_id: Count
    grid: RangeAzimuthGrid = RangeAzimuthGrid()
    #: complex64 [range, azimuth]; float32-valued (zero imaginary part) unless coherent.
    values: Annotated[np.ndarray, Array("<c8", ("grid.range_bins", "grid.azimuth_bins"))]
    #: Acquisition time of each azimuth column, int64 [azimuth].
    azimuth_stamp_ns: Annotated[np.ndarray, Array("<i8", ("grid.azimuth_bins",), -MAX_STAMP_NS, MAX_STAMP_NS)]
    #: Mean noise power in milliwatt per bin, measured beyond the map's range.
    noise_power_mw: Annotated[float, msgspec.Meta(ge=0.0, le=1e60)]
    #: Per range bin: the beams did not fit one coherent scene, magnitudes were interpolated; bool [range].
    incoherent: Annotated[np.ndarray, Array("|b1", ("grid.range_bins",))]
    #: Indices of beams that are missing or were left out as silent or interfered, and of those that were not asked for.
    missing_beams: tuple[Count, ...] = ()
    unused_beams: tuple[Count, ...] = ()
    #: Share of samples at full scale.
    saturated_share: Share = 0.0
    #: The radar's own motion was compensated beam by beam.
    ego_compensated: bool = False
    #: Pose of the radar on the vehicle with which the map was formed.
    vehicle_from_radar: Pose2 = Pose2()
    mode: str = "coherent"
    #: Names in `MAP_FAULTS` of the hardware faults visible in the scan.
    faults: tuple[str, ...] = ()
    #: Radial speed of each cell in cm/s, positive away from the radar, over ground where ego motion was compensated;
    #: `NO_RADIAL_SPEED` in noise; int16 [range, azimuth]. None: not measured.
    radial_speed_cmps: Annotated[np.ndarray, Array("<i2", ("grid.range_bins", "grid.azimuth_bins"))] | None = None
    #: Standard deviation of these at an SNR of 1; it falls with the root of a cell's SNR.
    radial_speed_unit_std_mps: StandardDeviation = 0.0
    #: Of maps that share beams with those before: what was measured after the `settled_stamp_ns` of the last one and up
    #: to this is new, with its neighbours. None: the beams of one scan, all of them new.
    settled_stamp_ns: StampNs | None = None

    def __repr__(self) -> str:
        grid, noise_mw = self.grid, self.noise_power_mw
        noise = f"noise {10.0 * math.log10(noise_mw):.1f} dBm a bin" if noise_mw > 0.0 else "noise unknown"
        cells = f"{grid.range_bins} x {grid.azimuth_bins} cells to {grid.range_m[-1]:.1f} m"
        return (
            f"RangeAzimuthMap(scan {self.scan_id}, {cells} and +-{grid.azimuth_limit_deg:g} deg, {self.mode}, {noise})"
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mode not in MAP_MODES:
            raise ValueError(f"map.mode must be one of {', '.join(MAP_MODES)}, got {self.mode!r}")
        if not set(self.faults) <= set(MAP_FAULTS):
            raise ValueError(f"map.faults must be among {', '.join(MAP_FAULTS)}, got {self.faults!r}")

    def radial_speed_mps(self, cells: tuple[Any, ...]) -> np.ndarray:
        """Return the radial speed of cells, an index of `values`, in m/s, NaN where it is not known; float64."""
        if self.radial_speed_cmps is None:
            return np.full(self.values[cells].shape, np.nan)
        return mps_from_speed_codes(self.radial_speed_cmps[cells])

    def stamps_at(self, azimuth_rad: np.ndarray) -> np.ndarray:
        """Return the acquisition times [N] of azimuths [N], those beyond the map at its edges; int64."""
        column = np.rint(self.grid.azimuth_index(azimuth_rad))
        return self.azimuth_stamp_ns[np.clip(column, 0, self.grid.azimuth_bins - 1).astype(np.int64)]
