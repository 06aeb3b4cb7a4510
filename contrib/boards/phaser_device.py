"""The Phaser kit (CN0566 board with a Pluto) through pyadi-iio: set up once, then a burst for every beam.

The Pluto's TDD engine starts ramp, receive buffer and transmit buffer of each chirp together: only then does a sample
belong to a known position on a ramp, and only then do beams add up coherently. The numbers are defined in
`contrib.boards.phaser_model`. The order of writes follows the maker's published examples; no board has confirmed it.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from contrib.boards.phaser_model import (
    CHIRP_INTERVAL_S,
    COLUMNS,
    ELEMENT_BEAMS,
    INTERMEDIATE_HZ,
    INTERVAL_SAMPLES,
    OFFSET_HZ,
    SAMPLE_RATE_HZ,
    TRANSMIT_GAIN_DB,
    BeamTable,
    PhaserCalibration,
    PhaserParams,
    beam_samples,
    beam_table,
    element_table,
    limits,
    radar_setup,
    synthesiser_words,
)
from msgs.values.radar import BeamGrid, RadarSetup
from nodes.process.launch_file import read_yaml_mapping
from nodes.process.validation import convert_at

_LOG = logging.getLogger(__name__)

#: The board and the Pluto answer within this, or the link counts as lost.
TIMEOUT_MS = 2000
#: Tolerance of the synthesiser's actual ramp.
_RAMP_TOLERANCE = 1e-3
#: The tone stays under the transmit converter's limit, in its 16-bit codes.
_TONE_AMPLITUDE = float(1 << 14)
_MUTED_DB = -88
_TDD_CHANNELS = 3
#: Transmit antenna: the switch's position of the maker's radar examples.
_TRANSMIT_SWITCH = 0


class Params(PhaserParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Addresses and settings of the kit."""

    #: The computer that carries the board, and the Pluto.
    board_uri: str = "ip:phaser.local"
    converter_uri: str = "ip:192.168.2.1"
    #: YAML file of `PhaserCalibration`; None: a perfect board.
    calibration: str | None = None
    #: Beams hear one element each, uncalibrated, for `mirrorwave calibrate array`.
    single_elements: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.single_elements and self.calibration is not None:
            raise ValueError("single_elements measures the bare board: calibration must not be given with it")


def load_library() -> Any:
    """Return pyadi-iio; raises `ValueError` with one line that names what to install."""
    try:
        return importlib.import_module("adi")
    except ImportError as error:
        raise ValueError(f"cn0566 needs pyadi-iio, extra `phaser`: {error}") from None
    except OSError as error:
        # pylibiio is there, the C library is missing or of another version
        raise ValueError(f"cn0566 needs libiio 0.x with pylibiio < 1, or both 1.x: {error.args[-1]}") from None


def load_calibration(path: Path) -> PhaserCalibration:
    """Return the calibration of one board. Raises `ValueError` that names file, field, value and rule."""
    return convert_at(read_yaml_mapping(path), PhaserCalibration, f"{path}: ")


class Cn0566:
    """One kit: `open`, then `steer` and `burst` for each beam; `close` mutes it."""

    def __init__(
        self, params: Params, beams: BeamGrid | None = None, library: Callable[[], Any] = load_library
    ) -> None:
        self._params = params
        self._adi = library()
        self._calibration = load_calibration(Path(params.calibration)) if params.calibration else PhaserCalibration()
        beams = ELEMENT_BEAMS if params.single_elements else beams or BeamGrid()
        self._table: BeamTable = (
            element_table(params) if params.single_elements else beam_table(params, self._calibration, beams)
        )
        self.setup: RadarSetup = radar_setup(params, beams, self._table.weights)
        #: Gains as last written.
        self._gain_codes = np.zeros(COLUMNS, np.int64)
        self._converter: Any = None
        self._board: Any = None
        self._timing: Any = None

    def open(self) -> None:
        """Find the kit and set it up. Raises `ConnectionError` if absent, `ValueError` if a setting is refused."""
        self._converter = self._opened(self._params.converter_uri, "Pluto", self._open_converter)
        self._board = self._opened(self._params.board_uri, "board", self._open_board)
        self._timing = self._opened(self._params.converter_uri, "Pluto's TDD engine", self._open_timing)
        with self._linked():
            self._set_converter()
            self._set_synthesiser()
            self._board.configure(device_mode="rx")
            self._write_gains(0)
            self._board.latch_rx_settings()
            # the oscillator's own tuning voltage, and its path to the transmitter
            self._board._gpios.gpio_vctrl_1 = 1
            self._board._gpios.gpio_vctrl_2 = 1
            self._board._gpios.gpio_tx_sw = _TRANSMIT_SWITCH
            self._set_timing()
        self._arm()
        _LOG.info("%s", describe(self._params))

    def steer(self, beam_index: int) -> None:
        """Write the phases of a beam, and gains if they differ; they take effect together, with the last write."""
        with self._linked():
            if (self._table.gain_codes[beam_index] != self._gain_codes).any():
                self._write_gains(beam_index)
            for element, phase_deg in enumerate(self._table.phases_deg[beam_index], start=1):
                self._board.elements[element].rx_phase = float(phase_deg)
            self._board.latch_rx_settings()

    def burst(self) -> np.ndarray:
        """Start the chirps of a beam; return I/Q codes int16 [chirps, samples, 2].

        Raises `ConnectionError`, and `ValueError` for a burst that is short or not finite.
        """
        with self._linked():
            channels = self._burst()
        return beam_samples(channels, self._params, self._calibration.channel_gains_db)

    def close(self) -> None:
        """Stop ramps and tone, as far as the kit still answers, and close the connection."""
        converter, board, timing = self._converter, self._board, self._timing
        self._converter = self._board = self._timing = None
        # independently: a lost part must not keep the rest on air
        with contextlib.suppress(OSError, AttributeError):
            converter.tx_destroy_buffer()
            converter.rx_destroy_buffer()
            converter.tx_hardwaregain_chan1 = _MUTED_DB
        with contextlib.suppress(OSError, AttributeError):
            timing.enable = False
        with contextlib.suppress(OSError, AttributeError):
            board.ramp_mode = "disabled"
            # the register is the power-down
            board.enable = 1

    def _opened(self, uri: str, part: str, opener: Callable[[], Any]) -> Any:
        """Return the object of `opener`. The library reports most errors as a bare `Exception`."""
        try:
            return opener()
        except Exception as error:
            message = " ".join(str(error).split()) or type(error).__name__
            raise ConnectionError(f"cn0566: no {part} at {uri} ({message}): check power, cable and address") from error

    def _open_converter(self) -> Any:
        # the Pluto class of the library has one channel; with its second opened it is an AD9361
        converter = self._adi.ad9361(uri=self._params.converter_uri)
        converter.ctx.set_timeout(TIMEOUT_MS)
        return converter

    def _open_board(self) -> Any:
        board = self._adi.CN0566(uri=self._params.board_uri, sdr=self._converter)
        board.ctx.set_timeout(TIMEOUT_MS)
        return board

    def _open_timing(self) -> Any:
        pins = self._adi.one_bit_adc_dac(self._params.converter_uri)
        pins.gpio_tdd_ext_sync = True
        pins.gpio_phaser_enable = True
        # the library keeps the channels on the class: after a lost link those of the dead one would come first
        self._adi.tddn.channel = []
        return self._adi.tddn(self._params.converter_uri)

    @contextlib.contextmanager
    def _linked(self) -> Iterator[None]:
        """Report errors in the body as a lost kit."""
        try:
            yield
        except OSError as error:
            where = f"{self._params.board_uri}, {self._params.converter_uri}"
            raise ConnectionError(f"cn0566: {where} no longer answer ({error}): check power and cables") from error

    def _set_converter(self) -> None:
        params, converter = self._params, self._converter
        converter.sample_rate = round(SAMPLE_RATE_HZ)
        converter.rx_lo = converter.tx_lo = round(INTERMEDIATE_HZ)
        converter.rx_enabled_channels = converter.tx_enabled_channels = [0, 1]
        for channel in ("chan0", "chan1"):
            setattr(converter, f"gain_control_mode_{channel}", "manual")
            setattr(converter, f"rx_hardwaregain_{channel}", params.receive_gain_db)
        converter.rx_buffer_size = params.burst_samples
        # no burst of an earlier beam may be queued
        converter._rxadc.set_kernel_buffers_count(1)
        converter.tx_cyclic_buffer = True
        # the board is fed from the second output
        converter.tx_hardwaregain_chan0 = _MUTED_DB
        converter.tx_hardwaregain_chan1 = TRANSMIT_GAIN_DB
        turns = OFFSET_HZ / SAMPLE_RATE_HZ * np.arange(INTERVAL_SAMPLES)
        tone = np.asarray(_TONE_AMPLITUDE * np.exp(2j * np.pi * (turns % 1.0)))
        converter.tx([0.5 * tone, tone])

    def _set_synthesiser(self) -> None:
        board, words = self._board, synthesiser_words()
        board.frequency = words.frequency_hz
        board.freq_dev_range = words.deviation_range_hz
        # the library adds one to its argument
        board.freq_dev_step = words.deviation_step_hz - 1
        board.freq_dev_time = words.deviation_time_us
        board.delay_word, board.delay_clk = 4095, "PFD"
        for name in ("delay_start_en", "ramp_delay_en", "trig_delay_en", "sing_ful_tri"):
            setattr(board, name, 0)
        board.ramp_mode = "single_sawtooth_burst"
        # each pulse of the timing engine starts a ramp
        board.tx_trig_en = 1
        # last: it writes all registers; 0 is on
        board.enable = 0
        self._check_ramp()

    def _check_ramp(self) -> None:
        """Compare the synthesiser's actual ramp with the request; range and azimuth are computed from it."""
        words = synthesiser_words()
        for name, wanted in (
            ("freq_dev_range", words.deviation_range_hz),
            ("freq_dev_time", words.deviation_time_us),
            ("frequency", words.frequency_hz),
        ):
            actual = float(getattr(self._board, name))
            if abs(actual - wanted) > _RAMP_TOLERANCE * wanted:
                raise ValueError(f"cn0566: {name} must be {wanted}, the synthesiser took {actual:g}")

    def _write_gains(self, beam_index: int) -> None:
        self._gain_codes = self._table.gain_codes[beam_index]
        for element, code in enumerate(self._gain_codes, start=1):
            self._board.elements[element].rx_gain = int(code)

    def _set_timing(self) -> None:
        timing = self._timing
        # its registers are written while it rests
        timing.enable = False
        timing.sync_external = True
        timing.startup_delay_ms = 0
        timing.frame_length_ms = 1e3 * CHIRP_INTERVAL_S
        timing.burst_count = self._params.chirps_per_beam
        for channel in timing.channel[:_TDD_CHANNELS]:
            channel.enable, channel.polarity = True, False
            channel.on_raw, channel.off_raw = 0, 10
        timing.enable = True

    def _arm(self) -> None:
        """Discard the first burst, which makes the receive buffer: its contents and its delay are meaningless."""
        with contextlib.suppress(OSError):
            self._burst()

    def _burst(self) -> list[np.ndarray]:
        for level in (0, 1, 0):
            self._board._gpios.gpio_burst = level
        return list(self._converter.rx())


def describe(params: Params) -> str:
    """Return the limits of the chirp on one line."""
    chirp_limits = limits(params)
    return (
        f"cn0566: bins of {chirp_limits.range_bin_m:.3f} m to {chirp_limits.range_limit_m:.0f} m, "
        f"{chirp_limits.speed_bin_mps:.2f} m/s to {chirp_limits.speed_limit_mps:.1f} m/s, "
        f"{1e3 * chirp_limits.beam_time_s:.1f} ms and {chirp_limits.beam_bytes / 1e6:.2f} MB a beam"
    )
