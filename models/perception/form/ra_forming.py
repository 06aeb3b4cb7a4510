"""Range-azimuth forming: raw beams in, one complex map a scan out, most of it done while the next beam is measured.

A beam is folded into slow-time sums, its background taken off, carried to the pose of the scan's first beam, Fourier
transformed over fast time and, bin by bin, over slow time; the profiles of all beams are then interpolated to the
azimuths of the map. |values|^2 is milliwatt per bin: a tone on a bin keeps its power whatever the window.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import msgspec
import numpy as np
import scipy.fft
from scipy.special import gammaincinv

from models.perception.form.coarray import SEEN_SPACINGS, AzimuthInterpolator
from models.perception.form.map_quality import ARRAY_LIMIT, ChannelTerms, array_deviation, channel_terms
from models.perception.form.radial_speed import HEARD, MIN_GROUPS, beam_speeds, cell_speeds
from models.perception.form.slow_time_sums import fold_chirps, group_edges
from models.physics.waveform import WINDOW_TAPS
from msgs.values.arrays import require_array, require_positive
from msgs.values.frames import Pose2
from msgs.values.radar import (
    FORMING_MODES,
    RadarBeam,
    RadarSetup,
    RangeAzimuthGrid,
    RangeAzimuthMap,
    amplitude_per_code,
)
from msgs.values.units import SPEED_OF_LIGHT_MPS, ratio_from_db, s_from_ns
from msgs.values.vehicle import VehicleState, ego_motion

#: A beam whose stated azimuth differs from the set-up's by more belongs to another set-up.
_AZIMUTH_TOLERANCE_RAD = 1e-3


#: Closing or opening speed up to which Doppler is searched.
DOPPLER_LIMIT_MPS = 45.0
#: A Doppler bin replaces the coherent mean only when it is this much stronger ...
DOPPLER_EXCESS_DB = 1.0
#: ... and this far above the noise: below, noise would select the bin and bias every cell upwards.
DOPPLER_SNR_DB = 13.0


class FormingParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of forming a map from beams."""

    #: Groups of chirps kept apart over slow time; None: every chirp. Never more than there are chirps.
    slow_time_sums: int | None = 8
    #: Doppler bins per 1 / beam duration.
    doppler_padding: int = 4
    #: A name in `WINDOW_TAPS`.
    range_window: str = "hann"
    #: "coherent"; "magnitude": azimuths from the magnitudes of the beams alone; "welch": mean power of single chirps,
    #: for flickering scenes.
    mode: str = "coherent"
    #: Only the first so many chirps of a beam are used; None: all.
    chirps: int | None = None
    #: Only every so many beams are used, from the first.
    beam_step: int = 1
    #: A map of the newest sweep every so many beams, most of them measured before the last map; None: one a scan.
    rolling_beams: int | None = None
    #: So many neighbouring samples are summed before the transform over fast time, and their droop taken out; fewer
    #: where chirps are short (`allowed_decimation`).
    decimation: int = 1
    #: Where the radar sits on the vehicle; ego motion is the vehicle's. None: as its set-up says, else at its origin.
    vehicle_from_radar: Pose2 | None = None

    def __post_init__(self) -> None:
        for name in ("slow_time_sums", "chirps", "rolling_beams"):
            if getattr(self, name) is not None:
                require_positive(f"forming.{name}", getattr(self, name))
        for name in ("doppler_padding", "beam_step", "decimation"):
            require_positive(f"forming.{name}", getattr(self, name))
        if self.range_window not in WINDOW_TAPS:
            raise ValueError(f"forming.range_window must be one of {sorted(WINDOW_TAPS)}, got {self.range_window!r}")
        if self.mode not in FORMING_MODES:
            raise ValueError(f"forming.mode must be one of {', '.join(FORMING_MODES)}, got {self.mode!r}")


@dataclass(frozen=True)
class ScanProfiles:
    """Folded beams of a scan: all that `form_map` needs."""

    stamp_ns: int
    scan_id: int
    #: complex64 [beams, range]; rows of missing beams are zero. Welch: magnitudes.
    profiles: np.ndarray
    #: Noise of one beam per bin.
    noise_power_mw: float
    #: Acquisition of each beam, int64 [beams]; missing beams at their nominal time.
    beam_stamp_ns: np.ndarray
    missing_beams: tuple[int, ...] = ()
    #: Beams that were not used.
    unused_beams: tuple[int, ...] = ()
    saturated_share: float = 0.0
    #: Hardware faults that the beams show, names in `MAP_FAULTS`.
    faults: tuple[str, ...] = ()
    #: Azimuth each beam looked at as seen from the map's pose, [beams, range]; None: ego motion was not taken out.
    look_azimuth_rad: np.ndarray | None = None
    #: Radial speed in each beam, float32 [beams, range], and its standard deviation at an SNR of 1; None: not measured.
    radial_speed_mps: np.ndarray | None = None
    radial_speed_unit_std_mps: float = 0.0
    #: As the map of these beams has it.
    settled_stamp_ns: int | None = None


@dataclass(frozen=True)
class EgoCorrection:
    """Factors that carry a beam measured on the move to the pose of the scan's first beam."""

    #: On each slow-time sum, complex64 [groups]; on each fast-time sample [samples]; on each range bin [range].
    group_phase: np.ndarray
    sample_phase: np.ndarray
    bin_phase: np.ndarray
    #: Azimuth of the beam's axis seen from the map's pose, [range].
    look_azimuth_rad: np.ndarray
    #: By how much the beam is moved along range.
    shift_m: float


def form_map(scan: ScanProfiles, interpolator: AzimuthInterpolator, mode: str = "coherent") -> RangeAzimuthMap:
    """Return the range-azimuth map of a scan's beam profiles.

    The noise power is that of coherent cells (0.58 of a beam's), of Welch cells, or of a beam if all are magnitudes.
    """
    missing, looks = tuple(sorted(scan.missing_beams + scan.unused_beams)), scan.look_azimuth_rad
    if mode != "coherent":
        values = interpolator.interpolate_magnitude(np.abs(scan.profiles), missing, looks).astype(np.complex64)
        incoherent = np.ones(interpolator.grid.range_bins, np.bool_)
        noise_power_mw = scan.noise_power_mw
    else:
        values, incoherent = interpolator.interpolate(scan.profiles, scan.noise_power_mw, missing, looks)
        noise_power_mw = scan.noise_power_mw * interpolator.noise_gain(missing)
    deviates = mode == "coherent" and not missing and _deviates(scan, interpolator, ~incoherent)
    return RangeAzimuthMap(
        stamp_ns=scan.stamp_ns,
        scan_id=scan.scan_id,
        grid=interpolator.grid,
        values=values,
        azimuth_stamp_ns=_azimuth_stamps(interpolator, scan),
        noise_power_mw=float(noise_power_mw),
        incoherent=incoherent,
        missing_beams=scan.missing_beams,
        unused_beams=scan.unused_beams,
        saturated_share=scan.saturated_share,
        ego_compensated=looks is not None,
        mode=mode,
        faults=(*scan.faults, "array_error") if deviates else scan.faults,
        radial_speed_cmps=_cell_speeds(scan, interpolator),
        radial_speed_unit_std_mps=scan.radial_speed_unit_std_mps,
        settled_stamp_ns=scan.settled_stamp_ns,
    )


def _cell_speeds(scan: ScanProfiles, interpolator: AzimuthInterpolator) -> np.ndarray | None:
    """Return the radial speed of every cell as the map has it; None where beams have none."""
    if scan.radial_speed_mps is None:
        return None
    power = scan.profiles.real**2 + scan.profiles.imag**2
    beams = interpolator.setup.beams.azimuth_rad
    looked_rad = beams if scan.look_azimuth_rad is None else scan.look_azimuth_rad[:, -1]
    apart_rad = np.abs(np.subtract.outer(interpolator.grid.azimuth_rad, looked_rad))
    reach_rad = SEEN_SPACINGS * float(np.median(np.abs(np.diff(beams))))
    return cell_speeds(scan.radial_speed_mps, power, scan.noise_power_mw, apart_rad <= reach_rad)


def _deviates(scan: ScanProfiles, interpolator: AzimuthInterpolator, coherent: np.ndarray) -> bool:
    """Return whether the coherent ranges [range] of a whole scan show another array than the set-up's."""
    if interpolator.coefficient_matrix is None:
        return False
    coefficients = scan.profiles[:, coherent].T @ interpolator.coefficient_matrix
    return array_deviation(coefficients, scan.noise_power_mw) > ARRAY_LIMIT


def _azimuth_stamps(interpolator: AzimuthInterpolator, scan: ScanProfiles) -> np.ndarray:
    """Return the acquisition time of each azimuth between the beams to its sides, afar; int64 [azimuth]."""
    azimuth_rad = interpolator.setup.beams.azimuth_rad
    # relative to the scan: nanoseconds since 1970 would not fit a float
    elapsed_ns = (scan.beam_stamp_ns - scan.stamp_ns).astype(np.float64)
    looked = np.setdiff1d(np.arange(len(azimuth_rad)), scan.missing_beams + scan.unused_beams)
    if scan.look_azimuth_rad is not None and len(looked):
        azimuth_rad, elapsed_ns = scan.look_azimuth_rad[looked, -1], elapsed_ns[looked]
    order = np.argsort(azimuth_rad, kind="stable")
    azimuth_rad, elapsed_ns = azimuth_rad[order], elapsed_ns[order]
    between_ns = np.interp(interpolator.grid.azimuth_rad, azimuth_rad, elapsed_ns)
    if scan.settled_stamp_ns is not None:
        # between the newest beam and the oldest nothing was measured half-way in time
        seam = int(np.argmax(np.abs(np.diff(elapsed_ns))))
        inside = (interpolator.grid.azimuth_rad > azimuth_rad[seam]) & (
            interpolator.grid.azimuth_rad < azimuth_rad[seam + 1]
        )
        is_upper = interpolator.grid.azimuth_rad[inside] > azimuth_rad[seam : seam + 2].mean()
        between_ns[inside] = elapsed_ns[seam + is_upper.astype(int)]
    return scan.stamp_ns + np.rint(between_ns).astype(np.int64)


class FoldedBeam(NamedTuple):
    """One beam folded over slow time."""

    #: complex64 [range].
    profile: np.ndarray
    #: Per bin.
    noise_power_mw: float
    #: Number of samples at full scale.
    saturated: int
    #: float32 [range], NaN in noise; None: slow time is not resolved.
    radial_speed_mps: np.ndarray | None
    channels: ChannelTerms


class BeamFolder:
    """Folder of one beam's samples into a range profile and its noise; holds what all beams of a set-up share."""

    def __init__(self, setup: RadarSetup, params: FormingParams, grid: RangeAzimuthGrid) -> None:
        radar = setup.radar
        if radar.samples_per_chirp % params.decimation:
            raise ValueError(
                f"forming.decimation must divide the {radar.samples_per_chirp} samples, got {params.decimation!r}"
            )
        if setup.array.digital and params.beam_step > 1:
            raise ValueError(
                "forming.beam_step must be 1 for a digital array: no other beam sees where one is left out, "
                f"got {params.beam_step!r}"
            )
        if setup.array.digital and params.rolling_beams is not None:
            raise ValueError(
                "forming.rolling_beams must be null for a digital array: all its beams are of one time, "
                f"got {params.rolling_beams!r}"
            )
        _check_grid(radar.range_bin_m, radar.samples_per_chirp, grid)
        self.decimation = allowed_decimation(params.decimation, radar.samples_per_chirp, grid.range_bins)
        #: Number of samples per chirp that are transformed.
        self.samples = radar.samples_per_chirp // self.decimation
        self.setup = setup
        mounted = (params.vehicle_from_radar, setup.vehicle_from_radar, Pose2())
        #: Where the radar sits on the vehicle.
        self.vehicle_from_radar = next(pose for pose in mounted if pose is not None)
        self.params = params
        self.grid = grid
        self.chirps = min(params.chirps or radar.chirps_per_beam, radar.chirps_per_beam)
        every = params.mode == "welch" or params.slow_time_sums is None
        self.groups = self.chirps if every else min(params.slow_time_sums or 1, self.chirps)
        edges = group_edges(self.chirps, self.groups)
        #: First chirp of each group and, last, the number of chirps.
        self.group_edges = edges
        self._group_chirps = np.diff(edges).astype(np.float32)
        #: Duration of the used part of a beam, and the middle of each group relative to its middle.
        self.duration_s = self.chirps * radar.repetition_interval_s
        self.group_time_s = 0.5 * (edges[1:] + edges[:-1]) * radar.repetition_interval_s - 0.5 * self.duration_s

    def fold(self, beam: RadarBeam, ego: EgoCorrection | None = None) -> FoldedBeam:
        """Return a beam folded over slow time."""
        sums, saturated = fold_chirps(beam.samples[: self.chirps], self.groups)
        channels = channel_terms(sums, self.setup.beat_sign, self.grid.range_bins)
        series = self._beats(sums, beam.beam_index)
        if ego is not None:
            series *= ego.sample_phase
        if self.decimation > 1:
            series = series.reshape(self.groups, self.samples, -1).sum(axis=2)
        spectra = scipy.fft.fft(series, axis=1, overwrite_x=True, workers=1)
        # milliwatt per code, over all that was summed
        codes = self.setup.radar.samples_per_chirp * self.chirps
        spectra *= np.float32(amplitude_per_code(beam.full_scale_dbm) / codes)
        speed_mps = None
        if self.params.mode == "welch":
            profile, noise_power_mw = self._welch(spectra)
        else:
            noise_power_mw = self._noise_power_mw(spectra)
            profiles = _windowed(spectra, 0, self.grid.range_bins, self._taps)
            profile, speed_mps = self.resolved(profiles, noise_power_mw, ego)
        if self.decimation > 1:
            profile = profile * self._undrooped
        profile = profile if ego is None else profile * ego.bin_phase
        return FoldedBeam(profile, noise_power_mw, saturated, speed_mps, channels)

    @property
    def _middle_wavelength_m(self) -> float:
        """Wavelength at the chirp's middle: there a windowed bin has its phase."""
        radar = self.setup.radar
        return SPEED_OF_LIGHT_MPS / (
            radar.carrier_hz + 0.5 * radar.chirp_slope_hz_per_s * radar.samples_per_chirp / radar.sample_rate_hz
        )

    @property
    def measures_speed(self) -> bool:
        """True where slow time is resolved."""
        return self.params.mode != "welch" and self.groups >= MIN_GROUPS

    def _radial_speed_mps(
        self, profiles: np.ndarray, row: np.ndarray, heard: np.ndarray, ego: EgoCorrection | None
    ) -> np.ndarray:
        """Return the radial speed of each bin heard, float32 [range]; `row`: that of the strongest Doppler."""
        speed_mps = np.full(profiles.shape[1], np.nan, np.float32)
        series = profiles[:, heard] if ego is None else profiles[:, heard] * ego.group_phase[:, None]
        coarse_rad_ps = 2.0 * np.pi * self._doppler_hz[row[heard]]
        speed_mps[heard] = beam_speeds(series, coarse_rad_ps, self.group_time_s, self._middle_wavelength_m)
        return speed_mps

    def _beats(self, sums: np.ndarray, beam_index: int) -> np.ndarray:
        """Return the sums complex64 [groups, samples] less the background, beat frequencies positive with range."""
        series: np.ndarray = sums.astype(np.float32).view(np.complex64)[..., 0]
        if self.setup.background is not None:
            series -= self._group_chirps[:, None] * self.setup.background[beam_index]
        return np.conj(series, out=series) if self.setup.beat_sign < 0 else series

    def resolved(
        self, profiles: np.ndarray, noise_power_mw: float, ego: EgoCorrection | None = None
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the strongest Doppler bin of each range bin, or the mean, complex64, and its radial speed, float32
        [range].

        `profiles` [groups, range] of the slow-time sums, windowed. NaN in noise; None where slow time is not resolved.
        """
        profile, row, power = self._strongest(self._doppler(profiles, ego), noise_power_mw)
        if not self.measures_speed:
            return profile, None
        return profile, self._radial_speed_mps(profiles, row, power > HEARD * noise_power_mw, ego)

    def _doppler(self, profiles: np.ndarray, ego: EgoCorrection | None) -> np.ndarray:
        transform = self._doppler_matrix if ego is None else self._doppler_matrix * ego.group_phase
        return np.asarray(transform @ profiles)

    def _noise_power_mw(self, spectra: np.ndarray) -> float:
        """Return the noise power per bin of the mean over all chirps."""
        return _median_power(np.abs(_windowed(spectra.sum(axis=0), *self._noise_bins, self._taps)) ** 2, 1)

    def _strongest(self, doppler: np.ndarray, noise_power_mw: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return row 0 of [Doppler, range], or the strongest where clearly another; the strongest's number, power."""
        power = doppler.real**2 + doppler.imag**2
        best = np.argmax(power, axis=0)
        best_power = np.take_along_axis(power, best[None], axis=0)[0]
        stronger = best_power > ratio_from_db(DOPPLER_EXCESS_DB) * power[0]
        audible = best_power > ratio_from_db(DOPPLER_SNR_DB) * noise_power_mw
        taken = np.where(stronger & audible, best, 0)
        return np.take_along_axis(doppler, taken[None], axis=0)[0], best, best_power

    def _welch(self, spectra: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the root of the power averaged over single chirps, as complex64 without imaginary part."""
        # one chirp has a share 1 / chirps of the sum's amplitude
        chirps = self.groups
        noise = np.mean(np.abs(_windowed(spectra, *self._noise_bins, self._taps) * chirps) ** 2, axis=0)
        power = np.mean(np.abs(_windowed(spectra, 0, self.grid.range_bins, self._taps) * chirps) ** 2, axis=0)
        return np.sqrt(power).astype(np.complex64), _median_power(noise, chirps)

    @property
    def _taps(self) -> tuple[float, ...]:
        return WINDOW_TAPS[self.params.range_window]

    @cached_property
    def _undrooped(self) -> np.ndarray:
        """Factor that restores the phase and magnitude that sums of neighbouring samples lose; complex64 [range]."""
        turns = np.arange(self.grid.range_bins) / self.setup.radar.samples_per_chirp
        droop = np.exp(2j * np.pi * np.multiply.outer(turns, np.arange(self.decimation))).mean(axis=1)
        return (1.0 / droop).astype(np.complex64)

    @cached_property
    def _noise_bins(self) -> tuple[int, int]:
        """First bin and count of those that hold noise alone: beyond the map, and short of its I/Q image."""
        beyond = self.samples - 2 * self.grid.range_bins
        if beyond < 128:
            # chirps this short leave nothing beyond the map: its own median, right while most cells are empty
            return 0, self.grid.range_bins
        guard = min(self.grid.range_bins, beyond // 4)
        return self.grid.range_bins + guard, beyond - 2 * guard

    @cached_property
    def _doppler_matrix(self) -> np.ndarray:
        """Slow-time DFT about the beam's middle, zero first; complex64 [Doppler, groups]."""
        return np.exp(-2j * np.pi * np.multiply.outer(self._doppler_hz, self.group_time_s)).astype(np.complex64)

    @cached_property
    def _doppler_hz(self) -> np.ndarray:
        """Frequencies of the rows of that matrix [Doppler]."""
        radar, params = self.setup.radar, self.params
        step_hz = 1.0 / (params.doppler_padding * self.duration_s)
        limit = int(2.0 * DOPPLER_LIMIT_MPS / radar.wavelength_m / step_hz)
        # beyond half the rate of the sums Doppler repeats
        limit = min(limit, (self.groups - 1) * params.doppler_padding // 2)
        return step_hz * np.concatenate([np.arange(limit + 1), -np.arange(1, limit + 1)])


def allowed_decimation(wanted: int, samples: int, range_bins: int) -> int:
    """Return the most samples to sum, at most `wanted`, that leave two for each range bin of the map."""
    fitting = (count for count in range(wanted, 1, -1) if samples % count == 0 and samples // count >= 2 * range_bins)
    return next(fitting, 1)


def _check_grid(range_bin_m: float, samples: int, grid: RangeAzimuthGrid) -> None:
    if abs(grid.range_bin_m / range_bin_m - 1.0) > 1e-6:
        raise ValueError(f"grid.range_bin_m must be the radar's c/2B = {range_bin_m!r}, got {grid.range_bin_m!r}")
    if grid.range_bins > samples:
        raise ValueError(f"grid.range_bins must be at most samples_per_chirp = {samples}, got {grid.range_bins!r}")


def _windowed(spectra: np.ndarray, first: int, count: int, taps: tuple[float, ...]) -> np.ndarray:
    """Return the bins first .. first + count - 1 of unwindowed spectra [..., bins] as a window's taps make them."""
    reach = len(taps) // 2
    bins = np.take(spectra, np.arange(first - reach, first + count + reach), axis=-1, mode="wrap")
    result = np.float32(taps[reach]) * bins[..., reach : reach + count]
    for i, tap in enumerate(taps):
        if i != reach:
            result += np.float32(tap) * bins[..., i : i + count]
    return result


def _median_power(power: np.ndarray, averages: int) -> float:
    """Return the mean power of complex white noise from the median of `averages`-fold periodograms."""
    return float(np.median(power) * averages / gammaincinv(averages, 0.5))


def ego_correction(folder: BeamFolder, beam_index: int, elapsed_s: float, state: VehicleState) -> EgoCorrection:
    """Return the correction of a beam whose middle lies `elapsed_s` after the map's pose, at constant motion.

    Exact phase along the beam's axis. The shift moves the beat by 2 S shift / c, its phase by 4 pi shift / lambda and,
    through the residual video phase, by a term linear in range.
    """
    radar = folder.setup.radar
    middle = displacement(folder, beam_index, elapsed_s, state)
    groups = [_start_from_now(state, elapsed_s + time_s, folder.vehicle_from_radar) for time_s in folder.group_time_s]
    group_shift_m = np.array([(pose.x_m, pose.y_m) for pose in groups]) @ _unit(middle.look_rad)
    delay_s = 2.0 * middle.shift_m / SPEED_OF_LIGHT_MPS
    sample_turns = radar.chirp_slope_hz_per_s * delay_s / radar.sample_rate_hz * np.arange(radar.samples_per_chirp)
    return EgoCorrection(
        group_phase=_turned(2.0 * group_shift_m / radar.wavelength_m),
        sample_phase=_turned(sample_turns),
        bin_phase=_video_phase(folder, middle.shift_m),
        look_azimuth_rad=middle.look_azimuth_rad(folder.grid),
        shift_m=middle.shift_m,
    )


class Displacement(NamedTuple):
    """Where a beam was measured, seen from the map's pose."""

    pose: Pose2
    #: Direction of its axis, and by how much the beam is moved along range.
    look_rad: float
    shift_m: float

    def look_azimuth_rad(self, grid: RangeAzimuthGrid) -> np.ndarray:
        """Return the azimuth of the beam's axis seen from the map's pose, [range]."""
        return _axis_azimuth(self.pose, self.look_rad, grid)


def displacement(folder: BeamFolder, beam_index: int, elapsed_s: float, state: VehicleState) -> Displacement:
    """Return where a beam was measured whose middle lies `elapsed_s` after the map's pose, before it if negative."""
    pose = _start_from_now(state, elapsed_s, folder.vehicle_from_radar)
    look_rad = float(folder.setup.beams.azimuth_rad[beam_index] + pose.yaw_rad)
    return Displacement(pose, look_rad, float(np.array([pose.x_m, pose.y_m]) @ _unit(look_rad)))


def moved_profile(folder: BeamFolder, profile: np.ndarray, shift_m: float, to_shift_m: float) -> np.ndarray:
    """Return a profile [range] that was moved along range by one shift as if by another; complex64.

    As `ego_correction`, after the transform; bins nearer to an edge than the difference lose what is beyond.
    """
    by_m = to_shift_m - shift_m
    if by_m == 0.0:
        return profile
    bins = len(profile)
    length = scipy.fft.next_fast_len(2 * bins)
    series = scipy.fft.ifft(profile * np.conj(_video_phase(folder, shift_m)), length)
    series *= _turned(by_m / folder.grid.range_bin_m / length * np.arange(length))
    turned = _turned(np.array(2.0 * by_m / folder.setup.radar.wavelength_m)) * _video_phase(folder, to_shift_m)
    moved: np.ndarray = scipy.fft.fft(series, overwrite_x=True)[:bins] * turned
    return moved.astype(np.complex64)


def _video_phase(folder: BeamFolder, shift_m: float) -> np.ndarray:
    """Return the residual video phase of a shift along range, complex64 [range]."""
    delay_s = 2.0 * shift_m / SPEED_OF_LIGHT_MPS
    slope = folder.setup.radar.chirp_slope_hz_per_s
    bin_turns = -0.5 * slope * delay_s * (4.0 * folder.grid.range_m / SPEED_OF_LIGHT_MPS - delay_s)
    return _turned(bin_turns)


def look_azimuths(setup: RadarSetup, grid: RangeAzimuthGrid, state: VehicleState) -> np.ndarray:
    """Return where each beam of a whole scan looked, from the map's pose, at nominal times; float64 [beams, range]."""
    looks = []
    for beam, azimuth_rad in enumerate(setup.beams.azimuth_rad):
        pose = ego_motion(state.speed_mps, state.yaw_rate_rps, beam_middle_s(setup, beam))
        looks.append(_axis_azimuth(pose, float(azimuth_rad + pose.yaw_rad), grid))
    return np.stack(looks)


def beam_middle_s(setup: RadarSetup, beam_index: int) -> float:
    """Return the nominal time of a beam's middle after the map's pose; 0 for a digital array, of one pose."""
    if setup.array.digital:
        return 0.0
    return s_from_ns(beam_index * setup.beam_interval_ns) + 0.5 * setup.radar.beam_duration_s


def _start_from_now(state: VehicleState, elapsed_s: float, vehicle_from_radar: Pose2) -> Pose2:
    """Return the radar's pose after a while, in its frame at the start."""
    vehicle = ego_motion(state.speed_mps, state.yaw_rate_rps, elapsed_s)
    return vehicle_from_radar.inverse() @ vehicle @ vehicle_from_radar


def _turned(turns: np.ndarray) -> np.ndarray:
    """Return exp(2 pi j turns) as complex64, reduced in float64."""
    return np.exp(2j * np.pi * (turns % 1.0)).astype(np.complex64)


def _unit(angle_rad: float) -> np.ndarray:
    """Return the unit vector of a direction, [2]."""
    return np.array([np.cos(angle_rad), np.sin(angle_rad)])


def _axis_azimuth(pose: Pose2, look_rad: float, grid: RangeAzimuthGrid) -> np.ndarray:
    """Return the azimuth at which the start sees the points of a displaced beam's axis; [range]."""
    start_m, axis = np.array([pose.x_m, pose.y_m]), _unit(look_rad)
    along_m = np.maximum(grid.range_m - start_m @ axis, 0.0)
    points_m = start_m + along_m[:, None] * axis
    azimuth_rad = np.arctan2(points_m[:, 1], points_m[:, 0])
    # inside the distance driven, the axis may point anywhere: keep the beam's own direction there
    return np.where(along_m > np.hypot(pose.x_m, pose.y_m), azimuth_rad, look_rad)


def check_beam(beam: RadarBeam, setup: RadarSetup) -> None:
    """Raise `ValueError` for a beam of another set-up."""
    radar = setup.radar
    if beam.beam_count != len(setup.beams):
        raise ValueError(f"beam.beam_count must be the set-up's {len(setup.beams)}, got {beam.beam_count!r}")
    require_array("beam.samples", beam.samples, "<i2", (radar.chirps_per_beam, radar.samples_per_chirp, 2))
    azimuth_rad = float(setup.beams.azimuth_rad[beam.beam_index])
    if abs(beam.azimuth_rad - azimuth_rad) > _AZIMUTH_TOLERANCE_RAD:
        raise ValueError(f"beam.azimuth_rad must be the set-up's {azimuth_rad:.6f}, got {beam.azimuth_rad!r}")
