"""A radar of your own as a node: its set-up once, then a beam whenever the hardware has one."""

from __future__ import annotations

import msgspec
from my_radar_hardware import Hardware

from msgs.bus.interface import Outgoing, Received
from msgs.values.radar import BeamGrid, RadarBeam, RadarParams, RadarSetup
from nodes.node import Node


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters that a launch file may set."""

    chirps_per_beam: int = 8
    #: Standard deviation of the receiver's noise, in codes.
    noise_codes: float = 20.0
    seed: int = 0


class MyRadar(Node):
    """radar/setup once, radar/beam at the pace of the scan."""

    outputs = ("radar/setup", "radar/beam")

    def __init__(self, params: Params) -> None:
        super().__init__()
        # what a receiver must know: waveform, array, azimuths, power of a full-scale tone; recorded beats have positive
        # frequency for positive range, else add beat_sign=-1
        radar = RadarParams(chirps_per_beam=params.chirps_per_beam)
        self._setup = RadarSetup(radar=radar, beams=BeamGrid(), full_scale_dbm=-20.0)
        self._hardware = Hardware(self._setup, params.noise_codes, params.seed)
        self._beams = 0
        self._next_ns: int | None = None

    def due_ns(self, now_ns: int) -> int | None:
        """Return the time of the next step: at once for the set-up, then whenever a beam is due."""
        return now_ns if self._next_ns is None else self._next_ns

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return one message a call: heartbeats come between."""
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
    """Return the node with its parameters."""
    return MyRadar(params)
