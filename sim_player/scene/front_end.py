"""Faults of a real front end that a scene may give its radar, all absent unless stated; each is one effect's."""

from __future__ import annotations

import msgspec


class Spur(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A tone of the electronics in every beam: beat frequency and power at the receiver's input."""

    frequency_hz: float
    power_dbm: float


class FrontEnd(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Faults of array and receiver."""

    #: Field that a column couples into its neighbour, relative to its own; falls by as much again per column.
    coupling_db: float | None = None
    coupling_phase_deg: float = 0.0
    #: Receiver's gain and phase difference between I and Q.
    iq_gain_db: float = 0.0
    iq_phase_deg: float = 0.0
    #: 1/f noise: frequency below which it exceeds the white noise; 0: none.
    flicker_corner_hz: float = 0.0
    #: Transmitter straight into the receiver: power at the receiver's input, and the range at which it beats.
    leakage_dbm: float | None = None
    leakage_range_m: float = 0.025
    #: Bits of the converter; the codes stay int16, its lower bits stay empty.
    adc_bits: int = 16
    spurs: tuple[Spur, ...] = ()


#: A front end without faults.
NO_FAULTS = FrontEnd()
