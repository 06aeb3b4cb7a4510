"""The horizontal row of a 77 GHz board as a digital array of the graph: set-up and beams of a frame of raw samples.

Beams are orthogonal sums of all virtual channels, so nothing of the row is lost: the former takes them apart again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from contrib.boards.dca1000_capture import Dca1000Config, array_params
from contrib.boards.digital_array import DigitalArrayParams, slots_aligned
from models.physics.antenna import setup_weights
from msgs.recording.mcap import whole_recording
from msgs.values.radar import ArrayParams, RadarBeam, RadarParams, RadarSetup, orthogonal_beams
from msgs.values.units import ns_from_s

#: Channels stand this near to whole half wavelengths.
_EVEN = 1e-6


def radar_setup(config: Dca1000Config, full_scale_dbm: float = -20.0, mirrored: bool = False) -> RadarSetup:
    """Return the set-up of a board's frames: a scan a frame, a chirp a loop.

    `full_scale_dbm` is not measured: ratios hold, levels in dBm do not until it is replaced by one's own. Raises
    `ValueError` for channels that make no row of half wavelengths without gap or double.
    """
    params, profile = array_params(config, mirrored=mirrored), config.profile
    columns = len(_columns(params))
    sampled_s = config.samples / config.sample_rate_hz
    return RadarSetup(
        radar=RadarParams(
            # of the first sample; half a wavelength of mid-sweep then is half a turn in the middle, as it should
            carrier_hz=1e9 * profile.start_frequency_ghz + 1e6 * profile.slope_mhz_per_us * profile.adc_start_time_us,
            bandwidth_hz=params.chirp_slope_hz_per_s * sampled_s,
            sample_rate_hz=params.sample_rate_hz,
            chirps_per_beam=config.frame.loops,
            samples_per_chirp=config.samples,
            scan_period_s=1e-3 * config.frame.period_ms,
            chirp_interval_s=len(config.transmitters) * params.chirp_interval_s,
        ),
        array=ArrayParams(columns=columns, rows=1, phase_bits=0, steered_ways=1, digital=True),
        beams=orthogonal_beams(columns),
        full_scale_dbm=full_scale_dbm,
    )


def row_beams(
    samples: np.ndarray, setup: RadarSetup, params: DigitalArrayParams, lost: np.ndarray | None = None
) -> np.ndarray:
    """Return I/Q codes int16 [beams, loops, samples, 2] of a frame, complex64 [loops, channels, samples].

    Slots of the transmitters are aligned first. Weights have unit power: noise keeps its level, and an echo gains the
    root of the number of channels; what exceeds the scale is cut there. Loops that are `lost`, bool [loops], are zero
    in all beams: the former then reports `lost_chirps`.
    """
    if lost is not None and lost.any():
        samples = np.where(lost[:, None, None], np.complex64(0.0), samples)
    columns = slots_aligned(samples, params)[:, _columns(params)]
    if lost is not None:
        columns[lost] = 0.0
    return beam_codes(columns, setup)


def beam_codes(columns: np.ndarray, setup: RadarSetup) -> np.ndarray:
    """Return I/Q codes int16 [beams, loops, samples, 2] of columns from right to left, complex64 [loops, columns,
    samples].
    """
    weights = setup_weights(setup).conj() / np.sqrt(setup.array.columns)
    beams = np.tensordot(weights.astype(np.complex64), columns, axes=(1, 1))
    codes = np.rint(np.stack([beams.real, beams.imag], axis=-1))
    return np.clip(codes, -32768, 32767).astype("<i2")


def write_scans(
    out: Path,
    attributes: dict[str, str],
    setup: RadarSetup,
    scans: Iterable[np.ndarray],
    on_frame: Callable[[], None] = lambda: None,
) -> int:
    """Write a set-up and scans, int16 [beams, loops, samples, 2] each, to the new recording `out`; returns the number
    of beams.
    """
    sequence = 0
    with whole_recording(out, attributes) as writer:
        writer.write("radar/setup", setup, publisher="import", sequence=0, sent_ns=0)
        for index, beams in enumerate(scans):
            stamp_ns = index * ns_from_s(setup.radar.scan_period_s)
            # sent when they have been measured, and so after the set-up
            sent_ns = stamp_ns + ns_from_s(setup.radar.beam_duration_s)
            for beam in beam_messages(beams, setup, index, stamp_ns):
                writer.write("radar/beam", beam, publisher="import", sequence=sequence, sent_ns=sent_ns)
                sequence += 1
            on_frame()
    return sequence


def beam_messages(beams: np.ndarray, setup: RadarSetup, scan_id: int, stamp_ns: int) -> list[RadarBeam]:
    """Return the beams of a frame, int16 [beams, loops, samples, 2], as the messages of a scan."""
    return [
        RadarBeam(
            stamp_ns=stamp_ns,
            scan_id=scan_id,
            beam_index=index,
            beam_count=len(setup.beams),
            azimuth_rad=float(azimuth_rad),
            samples=samples,
            full_scale_dbm=setup.full_scale_dbm,
        )
        for index, (azimuth_rad, samples) in enumerate(zip(setup.beams.azimuth_rad, beams, strict=True))
    ]


def lost_loops(gaps: Iterable[tuple[int, int]], config: Dca1000Config) -> np.ndarray:
    """Return the loops of a frame of which bytes are missing, bool [loops]; a gap is its first byte and its end."""
    lost = np.zeros(config.frame.loops, np.bool_)
    loop_bytes = config.frame_bytes // config.frame.loops
    for start, end in gaps:
        lost[start // loop_bytes : -(-end // loop_bytes)] = True
    return lost


def _columns(params: DigitalArrayParams) -> np.ndarray:
    """Return the channels from right to left, [columns]."""
    halves = 2.0 * np.array(params.channel_y_m) / params.wavelength_m
    order = np.argsort(halves, kind="stable")
    if np.abs(np.diff(halves[order]) - 1.0).max(initial=0.0) > _EVEN or len(order) < 2:
        raise ValueError(
            "channelCfg.rx_mask and chirpCfg.tx_mask must give at least two channels half a wavelength apart, "
            f"got places {', '.join(f'{place:g}' for place in halves[order])} in half wavelengths"
        )
    return order
