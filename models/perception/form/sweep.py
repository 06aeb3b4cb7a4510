"""The folded beams of one pass of the radar over all its directions, and of the newest parts of two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from models.perception.form.map_quality import (
    changing_bits,
    converter_faults,
    has_spurs,
    interfered_beams,
    lost_chirps,
    silent_beams,
    wiring_faults,
)
from models.perception.form.ra_forming import (
    BeamFolder,
    EgoCorrection,
    ScanProfiles,
    displacement,
    ego_correction,
    moved_profile,
)
from models.perception.form.radial_speed import unit_std_mps
from msgs.values.radar import RadarBeam
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState

#: Beams beside a direction that hold its echoes too: the main lobe of an array is 2.5 beams wide.
LOBE_BEAMS = 2


@dataclass(frozen=True)
class FoldedBeams:
    """Beams by their index, folded and carried to one pose; those that have not arrived have no noise."""

    #: complex64 [beams, range]; rows of beams that have not arrived are zero.
    profiles: np.ndarray
    #: Azimuth each looked at [beams, range], and by how much it was moved along range [beams].
    look_azimuth_rad: np.ndarray
    shift_m: np.ndarray
    #: float32 [beams, range].
    radial_speed_mps: np.ndarray
    #: Per bin [beams]; NaN: has not arrived.
    noise_power_mw: np.ndarray
    #: Acquisition, nominal of beams that have not arrived; int64 [beams].
    stamp_ns: np.ndarray
    #: Number of samples at full scale, and of chirps lost; int64 [beams].
    saturated: np.ndarray
    lost_chirps: np.ndarray
    #: Bits of I and Q that change, uint16 [beams, 2].
    changing_bits: np.ndarray
    #: `ChannelTerms` [beams, 2, range], [beams] and complex [beams]; the ranges beyond the leakage are the first.
    sides: np.ndarray
    channel_power: np.ndarray
    channel_product: np.ndarray

    @classmethod
    def none_of(cls, folder: BeamFolder, stamp_ns: int) -> FoldedBeams:
        """Return the beams of a sweep that begins at a time, before any has arrived."""
        beams = len(folder.setup.beams)
        shape = (beams, folder.grid.range_bins)
        return cls(
            profiles=np.zeros(shape, np.complex64),
            look_azimuth_rad=np.zeros(shape),
            shift_m=np.zeros(beams),
            radial_speed_mps=np.full(shape, np.nan, np.float32),
            noise_power_mw=np.full(beams, np.nan),
            stamp_ns=stamp_ns + folder.setup.beam_interval_ns * np.arange(beams, dtype=np.int64),
            saturated=np.zeros(beams, np.int64),
            lost_chirps=np.zeros(beams, np.int64),
            changing_bits=np.zeros((beams, 2), np.uint16),
            sides=np.zeros((beams, 2, folder.grid.range_bins)),
            channel_power=np.zeros(beams),
            channel_product=np.zeros(beams, np.complex128),
        )

    @property
    def received(self) -> np.ndarray:
        """Beams that have arrived, bool [beams]."""
        return ~np.isnan(self.noise_power_mw)

    def with_rest_of(self, older: FoldedBeams, count: int) -> FoldedBeams:
        """Return the first `count` of these beams with the rest of others."""
        rows = {field.name: (getattr(self, field.name), getattr(older, field.name)) for field in fields(self)}
        return FoldedBeams(**{name: np.concatenate([new[:count], old[count:]]) for name, (new, old) in rows.items()})

    def carry(self, folder: BeamFolder, beam: int, elapsed_s: float, state: VehicleState) -> None:
        """Carry a beam to the pose `elapsed_s` before its middle, from the one that it was carried to as it came."""
        moved = displacement(folder, beam, elapsed_s, state)
        by_m = moved.shift_m - self.shift_m[beam]
        self.profiles[beam] = moved_profile(folder, self.profiles[beam], self.shift_m[beam], moved.shift_m)
        self.radial_speed_mps[beam] = _shifted(self.radial_speed_mps[beam], round(by_m / folder.grid.range_bin_m))
        self.look_azimuth_rad[beam], self.shift_m[beam] = moved.look_azimuth_rad(folder.grid), moved.shift_m


class Sweep:
    """Beams of one pass over all directions: those of a scan so far."""

    def __init__(self, folder: BeamFolder, beam: RadarBeam, state: VehicleState | None) -> None:
        beams = len(folder.setup.beams)
        self.scan_id = beam.scan_id
        #: Acquisition of beam 0, nominal where another beam came first.
        self.stamp_ns = beam.stamp_ns - beam.beam_index * folder.setup.beam_interval_ns
        self._folder = folder
        self._state = _if_valid(state)
        #: Of the vehicle, at each beam.
        self._states: list[VehicleState | None] = [None] * beams
        self._beams = FoldedBeams.none_of(folder, self.stamp_ns)
        self._used = np.arange(beams) % folder.params.beam_step == 0

    def holds(self, beam: RadarBeam) -> bool:
        """Return whether a beam is one of this scan's."""
        return beam.scan_id == self.scan_id

    @property
    def complete(self) -> bool:
        """True once every used beam has arrived."""
        return bool(self._beams.received[self._used].all())

    def add(self, beam: RadarBeam, state: VehicleState | None = None) -> bool:
        """Fold one beam in; return False for a repeated beam. `state`: the vehicle's at this beam."""
        index, beams = beam.beam_index, self._beams
        if beams.received[index]:
            return False
        ego = self._ego(beam)
        folded = self._folder.fold(beam, ego)
        beams.profiles[index], beams.noise_power_mw[index] = folded.profile, folded.noise_power_mw
        if folded.radial_speed_mps is not None:
            beams.radial_speed_mps[index] = folded.radial_speed_mps
        if ego is not None:
            beams.look_azimuth_rad[index], beams.shift_m[index] = ego.look_azimuth_rad, ego.shift_m
        beams.stamp_ns[index] = beam.stamp_ns
        beams.saturated[index] = folded.saturated
        beams.lost_chirps[index] = lost_chirps(beam.samples[: self._folder.chirps])
        beams.changing_bits[index] = changing_bits(beam.samples[: self._folder.chirps])
        channels = folded.channels
        beams.sides[index, :, : channels.sides.shape[1]] = channels.sides
        beams.channel_power[index], beams.channel_product[index] = channels.power, channels.product
        self._states[index] = _if_valid(state)
        return True

    def _ego(self, beam: RadarBeam) -> EgoCorrection | None:
        if self._state is None:
            return None
        # beams made of one measurement have one pose, that of its middle: a phase for each would break their coherence
        digital = self._folder.setup.array.digital
        elapsed_s = 0.0 if digital else _middle_s(self._folder, beam.stamp_ns, self.stamp_ns)
        return ego_correction(self._folder, beam.beam_index, elapsed_s, self._state)

    def profiles(self, rolls: bool = False) -> ScanProfiles:
        """Return the folded beams of the scan; `rolls`: its map is one of several that share beams."""
        settled_stamp_ns = int(self._beams.stamp_ns[self._beams.received].max()) if rolls else None
        return self._profiles_of(self._beams, self.stamp_ns, self._state, settled_stamp_ns)

    def completed_by(self, last: Sweep, beam_index: int) -> ScanProfiles | None:
        """Return the beams up to `beam_index` with the rest of the sweep before, at the pose of the oldest; or None."""
        oldest = beam_index + 1
        if not self._follows(last) or (self._state is None) != (last._state is None):
            return None
        beams = self._beams.with_rest_of(last._beams, oldest)
        stamp_ns = int(beams.stamp_ns[oldest])
        state = last._states[oldest] or last._state
        if state is not None:
            for beam in _indices(beams.received):
                elapsed_s = _middle_s(self._folder, int(beams.stamp_ns[beam]), stamp_ns)
                beams.carry(self._folder, beam, elapsed_s, state)
        settled_stamp_ns = int(beams.stamp_ns[beam_index]) - LOBE_BEAMS * self._folder.setup.beam_interval_ns
        return self._profiles_of(beams, stamp_ns, state, settled_stamp_ns)

    def _follows(self, last: Sweep) -> bool:
        """Return whether a sweep is the one before this."""
        period_ns = ns_from_s(self._folder.setup.radar.scan_period_s)
        apart_ns = self.stamp_ns - last.stamp_ns
        return self.scan_id == last.scan_id + 1 and abs(apart_ns - period_ns) < period_ns // 2

    def _profiles_of(
        self, beams: FoldedBeams, stamp_ns: int, state: VehicleState | None, settled_stamp_ns: int | None
    ) -> ScanProfiles:
        """Return folded beams, silent and interfered ones left out as missing but for a digital array; median noise."""
        received, folder = beams.received, self._folder
        noise_power_mw = float(np.median(beams.noise_power_mw[received]))
        steered = not folder.setup.array.digital
        silent = received & steered & silent_beams(beams.profiles, noise_power_mw)
        interfered = steered & interfered_beams(beams.noise_power_mw)
        usable = received & ~silent & ~interfered
        faults = {
            "lost_chirps": beams.lost_chirps.any(),
            "silent_beams": silent.any(),
            "drowned_beams": interfered.any(),
            "spurs": has_spurs(beams.profiles[usable], noise_power_mw),
        }
        radar = folder.setup.radar
        samples = int(received.sum()) * folder.chirps * radar.samples_per_chirp
        return ScanProfiles(
            stamp_ns=stamp_ns,
            scan_id=self.scan_id,
            profiles=np.where(usable[:, None], beams.profiles, np.complex64(0.0)),
            noise_power_mw=noise_power_mw,
            beam_stamp_ns=beams.stamp_ns,
            missing_beams=_indices(self._used & ~usable),
            unused_beams=_indices(~self._used),
            saturated_share=int(beams.saturated.sum()) / samples,
            faults=tuple(
                dict.fromkeys(
                    (
                        *(name for name, holds in faults.items() if holds),
                        *wiring_faults(beams.sides.sum(axis=0), beams.channel_power.sum(), beams.channel_product.sum()),
                        *converter_faults(beams.changing_bits),
                    )
                )
            ),
            look_azimuth_rad=None if state is None else beams.look_azimuth_rad,
            radial_speed_mps=beams.radial_speed_mps if folder.measures_speed else None,
            radial_speed_unit_std_mps=unit_std_mps(radar.wavelength_m, folder.duration_s),
            settled_stamp_ns=settled_stamp_ns,
        )


def _if_valid(state: VehicleState | None) -> VehicleState | None:
    return state if state is not None and state.valid else None


def _indices(holds: Sequence[bool] | np.ndarray) -> tuple[int, ...]:
    return tuple(int(index) for index in np.flatnonzero(holds))


def _middle_s(folder: BeamFolder, beam_stamp_ns: int, pose_ns: int) -> float:
    """Return the time of a beam's middle after a pose."""
    return s_from_ns(beam_stamp_ns - pose_ns) + 0.5 * folder.duration_s


def _shifted(values: np.ndarray, cells: int) -> np.ndarray:
    """Return values [range] moved by whole cells, NaN where none were."""
    moved = np.full_like(values, np.nan)
    if abs(cells) < len(values):
        kept = values[max(-cells, 0) : len(values) - max(cells, 0)]
        moved[max(cells, 0) : max(cells, 0) + len(kept)] = kept
    return moved
