"""Streaming of beams into maps: one a scan of its own beams, or one every few beams of the newest sweep.

A sweep in progress is completed by the newest beams of the one before, carried to the pose of the oldest.
"""

from __future__ import annotations

import msgspec
import numpy as np

from models.perception.form.coarray import AzimuthInterpolator, require_formable
from models.perception.form.ra_forming import BeamFolder, FormingParams, ScanProfiles, check_beam, form_map
from models.perception.form.slow_time_sums import fold_chirps
from models.perception.form.sweep import Sweep
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.units import ns_from_s
from msgs.values.vehicle import VehicleState


class RaFormer:
    """Streams beams into maps (params None: the defaults; grid None: the default with the radar's range bins).

    The vehicle state given with a map's first beam holds for all of it. A beam of another scan, or `flush`, closes a
    scan that lacks beams; beams that repeat or come up to `LATE_SCANS` late are dropped and counted, numbers that fall
    further are of a source that restarted.
    """

    #: How many scans behind the newest one a beam may be and still count as late.
    LATE_SCANS = 2

    def __init__(
        self, setup: RadarSetup, params: FormingParams | None = None, grid: RangeAzimuthGrid | None = None
    ) -> None:
        params = params or FormingParams()
        require_formable(setup)
        self.interpolator = AzimuthInterpolator(setup, grid)
        self.folder = BeamFolder(setup, params, self.interpolator.grid)
        self.repeated_beams = 0
        self.late_beams = 0
        self._sweep: Sweep | None = None
        #: The sweep before, where maps roll.
        self._last: Sweep | None = None
        #: Number and stamp of the newest scan.
        self._newest: tuple[int, int] | None = None
        # compile now: the first beam must not wait for kernels, nor the first scan for matrices
        fold_chirps(np.zeros((1, 1, 2), np.int16), 1)
        self.interpolator.warm()

    @property
    def has_begun(self) -> bool:
        """True while a scan is under way."""
        return self._sweep is not None

    def add(self, beam: RadarBeam, state: VehicleState | None = None) -> list[RangeAzimuthMap]:
        """Fold one beam; the maps this completes, oldest first. Raises `ValueError` for a beam of another set-up."""
        check_beam(beam, self.folder.setup)
        if beam.beam_index % self.folder.params.beam_step or self._is_stale(beam):
            return []
        maps = [] if self._sweep is not None and self._sweep.holds(beam) else self.flush()
        if self._sweep is None:
            self._sweep = Sweep(self.folder, beam, state)
            self._newest = (self._sweep.scan_id, self._sweep.stamp_ns)
        if not self._sweep.add(beam, state):
            self.repeated_beams += 1
        elif self._sweep.complete:
            maps += self.flush()
        elif self._last is not None and self._rolls_at(beam.beam_index):
            # none where another motion completes the sweep
            profiles = self._sweep.completed_by(self._last, beam.beam_index)
            maps += [] if profiles is None else [self._map(profiles)]
        return maps

    def flush(self) -> list[RangeAzimuthMap]:
        """Close the scan under way: its map, whatever beams it lacks, or nothing."""
        if self._sweep is None:
            return []
        sweep, self._sweep = self._sweep, None
        rolls = self.folder.params.rolling_beams is not None
        self._last = sweep if rolls else None
        return [self._map(sweep.profiles(rolls))]

    def _map(self, profiles: ScanProfiles) -> RangeAzimuthMap:
        params = self.folder.params
        formed = form_map(profiles, self.interpolator, params.mode)
        return msgspec.structs.replace(formed, vehicle_from_radar=self.folder.vehicle_from_radar)

    def _rolls_at(self, beam_index: int) -> bool:
        """Return whether a map is due after a beam, before the next one in use."""
        step, every = self.folder.params.beam_step, self.folder.params.rolling_beams
        return every is not None and (beam_index + step) // every > beam_index // every

    def _is_stale(self, beam: RadarBeam) -> bool:
        """Count and refuse beams of scans already closed."""
        if self._newest is None or (self._sweep is not None and self._sweep.holds(beam)):
            return False
        scan_id, stamp_ns = self._newest
        later = beam.stamp_ns >= stamp_ns + ns_from_s(self.folder.setup.radar.scan_period_s)
        if later or not scan_id - self.LATE_SCANS <= beam.scan_id <= scan_id:
            return False
        if beam.scan_id == scan_id:
            self.repeated_beams += 1
        else:
            self.late_beams += 1
        return True
