"""A radar of one's own as a node: its set-up once, then a beam whenever the hardware has one.

    PYTHONPATH=docs/examples mirrorwave launch docs/examples/my_radar.yaml

`Hardware` stands for yours: it measures a wall of four points and noise.
"""

from __future__ import annotations

import msgspec
import numpy as np

from models.physics.antenna import setup_weights, two_way_pattern
from models.physics.waveform import beat_samples
from msgs.bus.interface import Outgoing, Received
from msgs.values.radar import BeamGrid, RadarBeam, RadarParams, RadarSetup
from nodes.node import Node


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a launch file may say."""

    chirps_per_beam: int = 8
    noise_codes: float = 20.0
    seed: int = 0


class Hardware:
    """Measures one beam: int16 I and Q codes [chirps, samples, 2]."""

    def __init__(self, setup: RadarSetup, noise_codes: float, seed: int) -> None:
        self._setup, self._noise_codes = setup, noise_codes
        self._random = np.random.default_rng(seed)
        across_m = np.linspace(-3.0, 3.0, 4)
        azimuth_rad = np.arctan2(across_m, 20.0)
        # the array's own field in every steered direction, [beams, points]: what makes the map coherent
        self._field = two_way_pattern(setup, setup_weights(setup), azimuth_rad, np.zeros_like(azimuth_rad))
        # recorded beats have positive frequency for positive range; else say `beat_sign: -1` in the set-up
        self._beats = beat_samples(setup.radar, 2.0 * np.hypot(20.0, across_m))

    def measure(self, beam_index: int) -> np.ndarray:
        """The beam of this place in the scan."""
        shape = (self._setup.radar.chirps_per_beam, self._setup.radar.samples_per_chirp)
        noise = self._noise_codes * (self._random.normal(size=shape) + 1j * self._random.normal(size=shape))
        codes = self._field[beam_index] @ self._beats + noise
        return np.rint(np.stack([codes.real, codes.imag], axis=-1)).astype(np.int16)


class MyRadar(Node):
    """radar/setup once, radar/beam at the pace of the scan."""

    outputs = ("radar/setup", "radar/beam")

    def __init__(self, params: Params) -> None:
        super().__init__()
        radar = RadarParams(chirps_per_beam=params.chirps_per_beam)
        # what a receiver must know: waveform, array, azimuths, power of a full-scale tone
        self._setup = RadarSetup(radar=radar, beams=BeamGrid(), full_scale_dbm=-20.0)
        self._hardware = Hardware(self._setup, params.noise_codes, params.seed)
        self._beams = 0
        self._next_ns: int | None = None

    def due_ns(self, now_ns: int) -> int | None:
        """At once for the set-up, then whenever a beam is due."""
        return now_ns if self._next_ns is None else self._next_ns

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """One message a call: heartbeats come between."""
        if self._next_ns is None:
            self._next_ns = now_ns + 300_000_000
            return [Outgoing("radar/setup", self._setup)]
        scan, index = divmod(self._beams, len(self._setup.beams))
        with self.stages("measure"):
            samples = self._hardware.measure(index)
        beam = RadarBeam(
            # the time of acquisition on the monotonic clock: the bus clock
            stamp_ns=self._next_ns,
            scan_id=scan,
            beam_index=index,
            beam_count=len(self._setup.beams),
            azimuth_rad=float(self._setup.beams.azimuth_rad[index]),
            samples=samples,
            full_scale_dbm=self._setup.full_scale_dbm,
        )
        self._beams += 1
        self._next_ns += self._setup.beam_interval_ns
        return [Outgoing("radar/beam", beam)]


def create(params: Params) -> MyRadar:
    """The node with its parameters."""
    return MyRadar(params)
