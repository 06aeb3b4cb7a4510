"""Node `radar_driver`: drives a real radar: set-up first, then beam after beam, at its scan rate or as fast as it can.

A lost link makes the node DEGRADED and is retried after a growing delay; the interrupted scan is left unfinished and
the next one begins. A burst that is short or not finite is left out, counted, and named.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import ClassVar, Protocol

import msgspec
import numpy as np

from contrib.boards import phaser_device
from msgs.bus.interface import Outgoing, Received
from msgs.values.arrays import require_positive
from msgs.values.diagnostics import NodeState
from msgs.values.radar import BeamGrid, RadarBeam, RadarSetup
from msgs.values.units import ns_from_s
from nodes.node import Node

_LOG = logging.getLogger(__name__)

RETRY_S, MAX_RETRY_S = 0.5, 10.0
#: Rest before the first beam, in which subscribers get ready, and after the last, for its transmission.
SETTLE_S = 0.3
#: A scan that takes this much longer than its set-up says is reported.
SLOW = 1.2


class Device(Protocol):
    """Interface of a kind of radar; `open`, `steer` and `burst` raise `ConnectionError` if it is lost."""

    setup: RadarSetup

    def open(self) -> None:
        """Find the device and set it up; again after a loss."""

    def steer(self, beam_index: int) -> None:
        """Steer the beam."""

    def burst(self) -> np.ndarray:
        """Return measured I/Q codes int16 [chirps, samples, 2]; `ValueError` for an invalid measurement."""

    def close(self) -> None:
        """Stop transmitting and close the connection."""


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scans of the radar, and its settings under its own name."""

    formerly: ClassVar[dict[str, str]] = {
        "": "contrib.boards.phaser_radar",
        "kind": "contrib.boards.phaser_radar",
        "cn0566": "contrib.boards.phaser_model",
        "cn0566.taper": "contrib.boards.phaser_model",
    }

    azimuth_deg: tuple[float, ...] | None = None
    #: Scans to measure; None: without end.
    scans: int | None = None
    cn0566: phaser_device.Params = phaser_device.Params()

    def __post_init__(self) -> None:
        if self.scans is not None:
            require_positive("radar_driver.scans", self.scans)

    @property
    def beams(self) -> BeamGrid:
        """Steering angles of a scan."""
        return BeamGrid() if self.azimuth_deg is None else BeamGrid(azimuth_deg=self.azimuth_deg)


class RadarDriver(Node):
    """radar/setup once, then radar/beam."""

    outputs = ("radar/setup", "radar/beam")

    def __init__(self, device: Device, params: Params) -> None:
        super().__init__()
        self._device, self._params = device, params
        self._setup = device.setup
        self._scan_id, self._beam_index = 0, 0
        #: When the next beam, or the next attempt, is due; None: the set-up has not been sent.
        self._due_ns: int | None = None
        self._scan_start_ns = 0
        self._lost, self._retry_s = False, RETRY_S
        #: Reason for missing beams; empty while all is well.
        self._trouble = self._slow = ""
        self._ended = False
        #: Tests replace the clock.
        self._clock_ns: Callable[[], int] = time.perf_counter_ns

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the next beam or the next attempt is due."""
        return now_ns if self._due_ns is None else self._due_ns

    def finished(self) -> bool:
        """Return true once the last beam has had time to arrive."""
        return self._ended

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while the radar is lost, gives no valid bursts or is slower than its set-up says."""
        reason = self._trouble or self._slow
        return (NodeState.DEGRADED, reason) if reason else (NodeState.READY, "")

    def close(self) -> None:
        """Silence the radar."""
        self._device.close()

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return the set-up, or one beam, or nothing after an attempt to find the radar again."""
        if self._due_ns is None:
            self._due_ns = now_ns + ns_from_s(SETTLE_S)
            self._setup = msgspec.structs.replace(self._setup, stamp_ns=now_ns)
            return [Outgoing("radar/setup", self._setup)]
        if now_ns < self._due_ns:
            return []
        if self._scan_id == self._params.scans:
            self._ended = True
            return []
        try:
            if self._lost:
                self._find()
            beam = self._measure(now_ns)
        except ConnectionError as error:
            self._lose(error, now_ns)
            return []
        return [] if beam is None else [Outgoing("radar/beam", beam)]

    def _find(self) -> None:
        with self.stages("open"):
            self._device.close()
            self._device.open()
        self._lost = False
        _LOG.info("found again")

    def _lose(self, error: Exception, now_ns: int) -> None:
        """Report the loss once, and retry after a growing delay; a begun scan stays unfinished."""
        if not self._lost:
            _LOG.warning("%s", error)
        if self._beam_index:
            self.shed.add("scan", "link lost")
            self._scan_id, self._beam_index = self._scan_id + 1, 0
        self._scan_start_ns, self._slow = 0, ""
        self._lost, self._trouble = True, f"{error}; next try in {self._retry_s:g} s"
        self._due_ns = now_ns + ns_from_s(self._retry_s)
        self._retry_s = min(2.0 * self._retry_s, MAX_RETRY_S)

    def _measure(self, now_ns: int) -> RadarBeam | None:
        """Return the next beam, stamped when its chirps began; None if the burst was invalid."""
        start_ns = self._clock_ns()
        with self.stages("steer"):
            self._device.steer(self._beam_index)
        stamp_ns = now_ns + self._clock_ns() - start_ns
        try:
            with self.stages("burst"):
                samples = self._device.burst()
        except ValueError as error:
            self._leave_out(error)
            samples = None
        beam = None if samples is None else self._beam(samples, stamp_ns)
        self._advance(now_ns)
        return beam

    def _beam(self, samples: np.ndarray, stamp_ns: int) -> RadarBeam:
        # only a beam is proof: a radar may answer and yet not measure
        self._trouble, self._retry_s = "", RETRY_S
        return RadarBeam(
            stamp_ns=stamp_ns,
            scan_id=self._scan_id,
            beam_index=self._beam_index,
            beam_count=len(self._setup.beams),
            azimuth_rad=float(self._setup.beams.azimuth_rad[self._beam_index]),
            samples=samples,
            full_scale_dbm=self._setup.full_scale_dbm,
        )

    def _leave_out(self, error: ValueError) -> None:
        self.shed.add("beam", "no sound burst")
        if not self._trouble:
            _LOG.warning("beam %d of scan %d: %s", self._beam_index, self._scan_id, error)
        self._trouble = str(error)

    def _advance(self, now_ns: int) -> None:
        """Advance to the next beam; a late radar is not hurried, its scans just take longer."""
        if self._beam_index == 0:
            took_s = 1e-9 * (now_ns - self._scan_start_ns)
            nominal_s = self._setup.radar.scan_period_s
            is_slow = self._scan_start_ns and took_s > SLOW * nominal_s
            self._slow = f"a scan takes {took_s:.2f} s, scan_period_s says {nominal_s:g} s" if is_slow else ""
            self._scan_start_ns = now_ns
        self._beam_index += 1
        assert self._due_ns is not None
        self._due_ns = max(self._due_ns + self._setup.beam_interval_ns, now_ns)
        if self._beam_index == len(self._setup.beams):
            self._scan_id, self._beam_index = self._scan_id + 1, 0
            if self._scan_id == self._params.scans:
                self._due_ns = now_ns + ns_from_s(SETTLE_S)


def create(params: Params) -> RadarDriver:
    """Return the node with its parameters; a radar absent now is bad input, one that is lost later is not."""
    device = phaser_device.Cn0566(params.cn0566, params.beams)
    try:
        device.open()
    except (ConnectionError, ValueError) as error:
        device.close()
        raise ValueError(str(error)) from None
    return RadarDriver(device, params)
