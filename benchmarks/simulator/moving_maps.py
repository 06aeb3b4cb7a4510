"""Maps of moving scenes at the kernel level (slow-time sums) against maps of their beats, by the same former.

Random places in which the radar drives at 8 m/s and turns by 10 deg/s and every road user moves at 8 m/s (pedestrians
1.5 m/s), all effects but noise and rounding. Of each place one scan, folded by the former with the vehicle's motion:
- the kernel level in single precision against all chirps of the beat level in double precision: |difference| in a cell
  over the strongest within one range bin and half a beam, or the noise's rms where that is more: of the slow-time sums,
  of the profiles (where two Doppler bins are alike, the former may choose either), and of the maps;
- the same against the literal level: one short beam, the strongest paths;
- what both leave out: paths that change within a beam, each group of chirps traced at its own time, against paths
  frozen at the beam's middle;
- processor time of a beam at either level, from paths to the profile.
Usage: OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.simulator.moving_maps [--places 10]
                                        [--literal-paths 100] [--seed 17] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
from rich.progress import track
from scipy.ndimage import maximum_filter

from benchmarks.simulator.moving_beams import OWN_SPEED_MPS, YAW_RATE_DPS, moving, processor_ms
from models.perception.forming.coarray import AzimuthInterpolator
from models.perception.forming.ra_forming import (
    BeamFolder,
    EgoCorrection,
    FormingParams,
    ScanProfiles,
    beam_middle_s,
    ego_correction,
    form_map,
)
from models.perception.forming.slow_time_sums import fold_chirps, group_edges
from msgs.values.radar import RadarBeam, RangeAzimuthGrid, amplitude_per_code
from msgs.values.vehicle import VehicleState
from sim_player.dataset.labelled_scan import noise_power_mw
from sim_player.effects.table import ALL_EFFECTS
from sim_player.generate.places import random_place
from sim_player.planner.plan import manual_plan
from sim_player.scene.world import prepare
from sim_player.signal.fmcw import noise_bank
from sim_player.signal.levels import Terms, echo_terms, record_beam, with_electronics
from sim_player.signal.literal import literal_echoes
from sim_player.signal.slow_time_profiles import group_noise, group_profiles
from sim_player.trace.path_tracks import PathTrack, tracing_step_s
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace
from tests.sim_player.signal.references import received_samples

#: Beam and chirps of the literal level.
LITERAL_BEAM, LITERAL_CHIRPS = 12, 8
#: Cells to either side within which the strongest one counts: one range bin, half a beam (12.7 deg) of the map's 120.
NEAR_MAP, NEAR_PROFILE = (3, 27), (3, 3)


class _Place:
    """One moving place, its signal without noise, and the former."""

    def __init__(self, seed: int, index: int) -> None:
        self.world = prepare(moving(random_place(seed, index)), index)
        self.setup = self.world.setup
        self.plan = manual_plan(self.world, self.setup, ALL_EFFECTS)
        self.signal = msgspec.structs.replace(self.plan.signal, thermal_noise=False, flicker=False, adc=False)
        self.front_end = self.world.scene.radar.front_end
        step_s = tracing_step_s(self.world, OWN_SPEED_MPS, self.setup.radar.scan_period_s)
        self.track = PathTrack(lambda time_s: trace(self.world, time_s, self.plan.used), step_s)
        self.folder = BeamFolder(self.setup, FormingParams(), RangeAzimuthGrid())
        self.state = VehicleState(stamp_ns=0, speed_mps=OWN_SPEED_MPS, yaw_rate_rps=float(np.radians(YAW_RATE_DPS)))

    @property
    def floor(self) -> float:
        """Rms of the noise in a slow-time sum."""
        return float(np.sqrt(noise_power_mw(self.setup) / self.folder.groups))

    def ego(self, beam: int) -> EgoCorrection:
        return ego_correction(self.folder, beam, beam_middle_s(self.setup, beam), self.state)

    def terms(self, paths: Paths, beam: int, precision: str) -> Terms:
        terms = echo_terms(self.setup, paths, self.signal, self.front_end, beam, precision)
        return with_electronics(self.setup, terms, self.signal, self.front_end, [beam])

    def sums(self, paths: Paths, beam: int, ego: EgoCorrection) -> np.ndarray:
        terms = self.terms(paths, beam, "float32")
        edges = self.folder.group_edges
        return group_profiles(self.setup, terms, edges, self.signal, self.front_end, ego.sample_phase)

    def beat_beam(self, paths: Paths, beam: int) -> RadarBeam:
        """All chirps of a beam, in codes so fine that rounding does not count."""
        terms = self.terms(paths, beam, "float64")
        samples = received_samples(self.setup, terms, np.zeros((2, 1)), [0], self.signal, self.front_end)
        peak = float(np.abs(samples).max()) or 1.0
        codes = np.stack([samples.real, samples.imag], axis=-1) * (16384.0 / peak)
        return RadarBeam(
            stamp_ns=beam * self.setup.beam_interval_ns,
            scan_id=0,
            beam_index=beam,
            beam_count=len(self.setup.beams),
            azimuth_rad=float(self.setup.beams.azimuth_rad[beam]),
            samples=np.rint(codes).astype(np.int16),
            full_scale_dbm=float(20.0 * np.log10(2.0 * peak)),
        )

    def profiles(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Kernel and beat profile of each beam by the same former, where the beam looked, and the errors of the
        slow-time sums before one Doppler bin is chosen, dB.
        """
        noise_mw = noise_power_mw(self.setup)
        for beam in range(len(self.setup.beams)):
            paths, ego = self.track.at(beam_middle_s(self.setup, beam)), self.ego(beam)
            sums = self.sums(paths, beam, ego), self.sums_of(self.beat_beam(paths, beam), ego)
            got, wanted = (
                self.folder.resolved(one.astype(np.complex64), noise_mw, ego)[0] * ego.bin_phase for one in sums
            )
            yield got, wanted, ego.look_azimuth_rad, apart_db(*sums, self.floor, (1, 3))

    def sums_of(self, codes: RadarBeam, ego: EgoCorrection) -> np.ndarray:
        """Windowed profiles of the slow-time sums of all chirps."""
        sums = fold_chirps(codes.samples, self.folder.groups)[0] @ np.array([1.0, 1.0j])
        if self.setup.beat_sign < 0:
            sums = np.conj(sums)
        count = sums.shape[1]
        window = (1.0 - np.cos(2.0 * np.pi * np.arange(count) / count)) / (count * self.setup.radar.chirps_per_beam)
        spectra = np.fft.fft(sums * ego.sample_phase * window, axis=1)[:, : self.folder.grid.range_bins]
        return np.asarray(spectra * amplitude_per_code(codes.full_scale_dbm))

    def literal(self, count: int) -> tuple[float, float]:
        """Relative L2 and worst cell of slow-time sums of the strongest paths against the literal level."""
        radar = msgspec.structs.replace(self.setup.radar, chirps_per_beam=LITERAL_CHIRPS)
        setup = msgspec.structs.replace(self.setup, radar=radar)
        paths = self.track.at(beam_middle_s(setup, LITERAL_BEAM))
        paths = paths.take(np.argsort(-np.abs(paths.amplitude), kind="stable")[:count])
        plain = msgspec.structs.replace(self.signal, iq_imbalance=False, leakage=False, spurs=False)
        edges = group_edges(LITERAL_CHIRPS, 8)
        terms = echo_terms(setup, paths, plain, self.front_end, LITERAL_BEAM, "float32")
        got = group_profiles(setup, terms, edges, plain, self.front_end)
        chirps = literal_echoes(setup, paths, plain, self.front_end, LITERAL_BEAM, range(LITERAL_CHIRPS))
        count = chirps.shape[1]
        window = (1.0 - np.cos(2.0 * np.pi * np.arange(count) / count)) / count / LITERAL_CHIRPS
        wanted = np.fft.fft(chirps * window, axis=1)[:, : got.shape[1]]
        level = 20.0 * np.log10(np.linalg.norm(got - wanted) / np.linalg.norm(wanted))
        return float(level), float(apart_db(got, wanted, self.floor, (1, 3)).max())

    def frozen(self, beam: int) -> tuple[np.ndarray, np.ndarray]:
        """Slow-time sums of paths at the beam's middle against those of paths at each group's own time, dB per cell of
        the sums and of their mean.
        """
        edges, radar = self.folder.group_edges, self.setup.radar
        middle_s = beam_middle_s(self.setup, beam)
        short = msgspec.structs.replace(radar, chirps_per_beam=int(edges[1] - edges[0]))
        setup = msgspec.structs.replace(self.setup, radar=short)
        bare = echo_terms(self.setup, self.track.at(middle_s), self.signal, self.front_end, beam, "float32")
        frozen = group_profiles(self.setup, bare, edges, self.signal, self.front_end)
        exact = np.empty_like(frozen)
        for group, time_s in enumerate(middle_s + self.folder.group_time_s):
            terms = echo_terms(setup, self.track.at(float(time_s)), self.signal, self.front_end, beam, "float32")
            whole = group_profiles(setup, terms, np.array([0, short.chirps_per_beam]), self.signal, self.front_end)
            exact[group] = whole[0] / len(frozen)
        return apart_db(frozen, exact, self.floor, (1, 3)), apart_db(
            frozen.sum(axis=0)[None], exact.sum(axis=0)[None], self.floor, (1, 3)
        )

    def times(self) -> dict[str, float]:
        """Processor time of a beam with all effects at either level, ms."""
        setup, front_end, edges = self.setup, self.front_end, self.folder.group_edges
        paths, ego, bank = self.track.at(0.15), self.ego(12), noise_bank(self.setup.radar, 0)
        terms = self.terms(paths, 12, "float32")
        signal = self.plan.signal

        def kernel() -> None:
            sums = group_profiles(setup, terms, edges, signal, front_end, ego.sample_phase)
            noisy = (sums + group_noise(setup, edges, [0], signal, front_end)).astype(np.complex64)
            self.folder.resolved(noisy, 1e-14, ego)[0]

        def beat() -> None:
            codes = record_beam(setup, terms, bank, [0, 5, 0, 0], signal, front_end)
            beam = self.beat_beam_of(codes)
            self.folder.fold(beam, ego)

        return {
            "echoes": processor_ms(lambda: self.terms(paths, 12, "float32")),
            "kernel, the rest": processor_ms(kernel),
            "beats, the rest": processor_ms(beat),
        }

    def beat_beam_of(self, codes: np.ndarray) -> RadarBeam:
        return RadarBeam(
            stamp_ns=0, scan_id=0, beam_index=12, beam_count=25, azimuth_rad=0.0, samples=codes,
            full_scale_dbm=self.setup.full_scale_dbm,
        )  # fmt: skip


def apart_db(got: np.ndarray, wanted: np.ndarray, floor: float, near: tuple[int, int]) -> np.ndarray:
    """Difference of each cell over the strongest one near it, or a floor, dB."""
    strongest = np.maximum(maximum_filter(np.abs(wanted), near, mode="nearest"), max(floor, 1e-300))
    return np.asarray(20.0 * np.log10(np.maximum(np.abs(got - wanted) / strongest, 1e-15)))


def row_of(place: _Place, literal_paths: int) -> dict[str, Any]:
    """All figures of one place."""
    got, wanted, looks, sums_db = (np.stack(part) for part in zip(*place.profiles(), strict=True))
    noise_mw = noise_power_mw(place.setup)
    interpolator = AzimuthInterpolator(place.setup, RangeAzimuthGrid())
    stamps = place.setup.beam_interval_ns * np.arange(len(got), dtype=np.int64)
    maps = [
        form_map(ScanProfiles(0, 0, one, noise_mw, stamps, look_azimuth_rad=looks), interpolator)
        for one in (got, wanted)
    ]
    profile_db = apart_db(got.T, wanted.T, np.sqrt(noise_mw), NEAR_PROFILE)
    map_db = apart_db(maps[0].values, maps[1].values, np.sqrt(noise_mw), NEAR_MAP)
    frozen_db, mean_db = (
        np.concatenate([cells.ravel() for cells in one])
        for one in zip(*(place.frozen(beam) for beam in (0, 12, 24)), strict=True)
    )
    return {
        "place": place.world.scene.name,
        "paths": len(place.track.at(0.0)),
        "sums_db": quantiles(sums_db),
        "profile_db": quantiles(profile_db),
        "map_db": quantiles(map_db),
        "map_over_40_db": float(np.mean(map_db > -40.0)),
        "bins_alike": float(np.mean(maps[0].incoherent == maps[1].incoherent)),
        "literal_db": place.literal(literal_paths),
        "frozen_db": quantiles(frozen_db),
        "frozen_mean_db": quantiles(mean_db),
        "times_ms": place.times(),
    }


def quantiles(values: np.ndarray) -> tuple[float, float, float]:
    """Median, 99.9 % and worst."""
    middle, most, worst = np.quantile(values, [0.5, 0.999, 1.0]).tolist()
    return middle, most, worst


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--literal-paths", type=int, default=100)
    parser.add_argument("--seed", type=int, default=17)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = [
        row_of(_Place(arguments.seed, index), arguments.literal_paths)
        for index in track(range(arguments.places), transient=True)
    ]
    machine = f"{platform.machine()}, {os.cpu_count()} cores"
    if arguments.json:
        print(json.dumps({"machine": machine, "seed": arguments.seed, "rows": rows}))
        return
    for row in rows:
        worst = [
            f"{row[name][-1]:.0f}"
            for name in ("sums_db", "profile_db", "map_db", "literal_db", "frozen_db", "frozen_mean_db")
        ]
        print(
            f"{row['place']:28s} {row['paths']:5d} paths; worst cell, dB: sums {worst[0]}, profiles {worst[1]}, "
            f"map {worst[2]} (99.9 %: {row['map_db'][1]:.0f}; over -40: {1e6 * row['map_over_40_db']:.0f} per million; "
            f"alike {100.0 * row['bins_alike']:.2f} %), literal {worst[3]}, frozen {worst[4]} "
            f"(99.9 %: {row['frozen_db'][1]:.0f}; mean over the beam {worst[5]})"
        )
    for name in rows[0]["times_ms"]:
        times_ms = [row["times_ms"][name] for row in rows]
        print(f"{name:18s} median {np.median(times_ms):7.2f}  least {min(times_ms):7.2f}  most {max(times_ms):7.2f} ms")


if __name__ == "__main__":
    main()
