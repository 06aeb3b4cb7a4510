"""Raw captures of TI's 60 and 77 GHz boards: chirp configuration, layout of the file, samples for the digital array.

A file is int16 without header, frame after frame, chirp after chirp. Two lanes (xWR16xx, xWR18xx): one receiver after
the other, its samples in pairs I0 I1 Q0 Q1. Four lanes (xWR14xx): one sample after the other, I of the four receivers,
then their Q. With `sample_swap` 1 in `adcbufCfg`, Q precedes I. Source: TI SWRA581B, sections 5 and 6. Real samples
(AWR2944, AWRL6844, or `adcCfg` 2 0) have no Q. A cascade of four AWR2243 has a file for each device: one sample after
the other, I and Q of each of its four receivers (TI's MMWCAS-DSP-EVM).

The configuration is that of TI's command line (`.cfg`), a JSON object with the same commands as keys, or a script of
mmWave Studio (`contrib.boards.mmwave_studio`). Its gaps are filled by assumptions: receivers half a wavelength of the
sweep's middle apart, and the array as in `Device`.
"""

from __future__ import annotations

import re
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
import scipy.fft

from contrib.boards.digital_array import DigitalArrayParams
from contrib.boards.l_sdk import L_SDK_COMMANDS, l_sdk_fields, l_sdk_words
from msgs.values.arrays import require_array, require_positive
from msgs.values.known_names import with_known_names
from msgs.values.radar import RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS
from msgs.values.wording import counted

DeviceName = Literal["xwr14xx", "xwr16xx", "xwr18xx", "awr2944", "awrl6844", "awr2243_cascade"]
_BYTES_PER_CODE = 2
#: Of all devices; the band of one is `Device.band_ghz`.
_BANDS_GHZ = (57.0, 81.0)
#: Height of the ends of the window under which real samples become complex: it is divided by.
_PEDESTAL = 0.05
#: Limit of TI's loops and frames.
_MAX_COUNT = 65535


Row = tuple[tuple[int | None, ...], ...]


class Device(NamedTuple):
    """LVDS lanes of a device and its horizontal row."""

    lanes: int
    #: Place of each pair of a transmitter and a receiver in half wavelengths; None: at another height.
    row: Row
    band_ghz: tuple[float, float] = (76.0, 81.0)
    #: Its samples are real, whatever is configured.
    is_real: bool = False
    #: Transmitters whose field is turned round.
    turned: tuple[int, ...] = ()
    #: Devices that write a file each.
    parts: int = 1

    @property
    def receivers(self) -> int:
        """Number of receivers."""
        return len(self.row[0])


def _row(transmitters: tuple[int | None, ...], receivers: tuple[int, ...] = (0, 1, 2, 3)) -> Row:
    """Return the places of pairs whose transmitters and receivers stand at these."""
    return tuple(tuple(None if start is None else start + at for at in receivers) for start in transmitters)


#: The evaluation boards of each device. Sources: BOOST boards, TI SWRA581B; AWR2944EVM, its SDK's `antGeometryCfg`;
#: AWRL6844EVM, table 3-1 of its user's guide (16 places, four rows of four: the highest); MMWCAS-RF-EVM, TI's
#: `module_params.m`: 86 places, some taken twice.
DEVICES: dict[DeviceName, Device] = {
    "xwr14xx": Device(4, _row((0, None, 4))),
    "xwr16xx": Device(2, _row((0, 4))),
    "xwr18xx": Device(2, _row((0, None, 4))),
    "awr2944": Device(2, _row((0, None, 4, 8)), is_real=True),
    "awrl6844": Device(
        2, ((2, None, None, 3), (0, None, None, 1), (None,) * 4, (None,) * 4), (57.0, 64.0), is_real=True, turned=(1, 3)
    ),
    "awr2243_cascade": Device(
        4,
        _row(
            (None, None, None, 32, 28, 24, 20, 16, 12, 8, 4, 0),
            (11, 12, 13, 14, 50, 51, 52, 53, 46, 47, 48, 49, 0, 1, 2, 3),
        ),
        parts=4,
    ),
}


def _require_between(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} must be {low:g}..{high:g}, got {value!r}")


def _require_value(name: str, value: float, expected: int, rule: str) -> None:
    if value != expected:
        raise ValueError(f"{name} must be {expected} ({rule}), got {value!r}")


class ChannelCfg(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Receivers and transmitters that are switched on, a bit each."""

    rx_mask: int
    tx_mask: int
    cascading: int = 0

    def __post_init__(self) -> None:
        _require_between("rx_mask", self.rx_mask, 1, 0xFFFF)
        _require_between("tx_mask", self.tx_mask, 1, 0xFFF)
        _require_value("cascading", self.cascading, 0, "a single device")


class AdcCfg(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Word length and format of the samples."""

    adc_bits: int
    #: 0: real, 1: complex, 2: complex with the image band.
    output_format: int

    def __post_init__(self) -> None:
        _require_value("adc_bits", self.adc_bits, 2, "16 bits")
        _require_between("output_format", self.output_format, 0, 2)


class AdcbufCfg(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Order of the samples within a chirp."""

    subframe: int = -1
    output_format: int = 0
    sample_swap: int = 0
    channel_interleave: int = 1
    chirp_threshold: int = 1

    def __post_init__(self) -> None:
        _require_value("subframe", self.subframe, -1, "no subframes")
        _require_between("output_format", self.output_format, 0, 1)
        _require_between("sample_swap", self.sample_swap, 0, 1)
        _require_between("channel_interleave", self.channel_interleave, 0, 1)


class LvdsStreamCfg(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Content of the lanes."""

    subframe: int = -1
    header: int = 0
    data_format: int = 1
    software: int = 0

    def __post_init__(self) -> None:
        _require_value("subframe", self.subframe, -1, "no subframes")
        _require_value("header", self.header, 0, "no headers")
        _require_value("data_format", self.data_format, 1, "ADC samples alone")
        _require_value("software", self.software, 0, "no user data")


class ProfileCfg(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A chirp: its sweep, times and samples."""

    profile_id: int
    start_frequency_ghz: float
    idle_time_us: float
    adc_start_time_us: float
    ramp_end_time_us: float
    tx_backoff: int
    tx_phase_shifter: int
    slope_mhz_per_us: float
    tx_start_time_us: float
    adc_samples: int
    sample_rate_ksps: float
    hpf_corner_1: int
    hpf_corner_2: int
    rx_gain_db: int

    def __post_init__(self) -> None:
        for name in ("idle_time_us", "ramp_end_time_us", "slope_mhz_per_us", "sample_rate_ksps"):
            require_positive(name, getattr(self, name))
        _require_between("adc_samples", self.adc_samples, 2, 4096)
        _require_between("adc_start_time_us", self.adc_start_time_us, 0.0, self.ramp_end_time_us)
        _require_between("start_frequency_ghz", self.start_frequency_ghz, *_BANDS_GHZ)
        end_us = self.adc_start_time_us + 1e3 * self.adc_samples / self.sample_rate_ksps
        if end_us > self.ramp_end_time_us:
            raise ValueError(f"ramp_end_time_us must not be before the last sample, {end_us:g}, "
                             f"got {self.ramp_end_time_us!r}")  # fmt: skip

    @property
    def chirp_interval_s(self) -> float:
        """Time from one chirp to the next."""
        return 1e-6 * (self.idle_time_us + self.ramp_end_time_us)

    @property
    def middle_hz(self) -> float:
        """Carrier in the middle of the sampled part of the sweep."""
        middle_us = self.adc_start_time_us + 0.5e3 * self.adc_samples / self.sample_rate_ksps
        return 1e9 * self.start_frequency_ghz + 1e6 * self.slope_mhz_per_us * middle_us


class ChirpCfg(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Chirps of equal kind: their profile and transmitter; deviations from the profile are refused."""

    start_index: int
    end_index: int
    profile_id: int
    start_frequency_deviation: float = 0.0
    slope_deviation: float = 0.0
    idle_time_deviation: float = 0.0
    adc_start_time_deviation: float = 0.0
    tx_mask: int

    def __post_init__(self) -> None:
        _require_between("start_index", self.start_index, 0, 511)
        _require_between("end_index", self.end_index, self.start_index, 511)
        for name in ("start_frequency", "slope", "idle_time", "adc_start_time"):
            field = f"{name}_deviation"
            _require_value(field, getattr(self, field), 0, "all chirps alike")
        if self.tx_mask not in [1 << at for at in range(12)]:
            raise ValueError(f"tx_mask must name one transmitter (1, 2, 4, ...), got {self.tx_mask!r}")


class FrameCfg(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Chirps of a loop, loops of a frame, frames of the capture (0: until it was stopped)."""

    chirp_start_index: int
    chirp_end_index: int
    loops: int
    frames: int
    period_ms: float
    trigger: int = 1
    trigger_delay_ms: float = 0.0

    def __post_init__(self) -> None:
        _require_between("chirp_start_index", self.chirp_start_index, 0, 511)
        _require_between("chirp_end_index", self.chirp_end_index, self.chirp_start_index, 511)
        _require_between("loops", self.loops, 1, _MAX_COUNT)
        _require_between("frames", self.frames, 0, _MAX_COUNT)
        require_positive("period_ms", self.period_ms)


class Dca1000Config(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    rename={
        "channel": "channelCfg",
        "adc": "adcCfg",
        "adcbuf": "adcbufCfg",
        "lvds": "lvdsStreamCfg",
        "profile": "profileCfg",
        "chirps": "chirpCfg",
        "frame": "frameCfg",
    },
):
    """Device and chirps of a capture; raises `ValueError` naming the field if its parts do not fit each other."""

    device: DeviceName
    channel: ChannelCfg
    adc: AdcCfg
    adcbuf: AdcbufCfg | None = None
    lvds: LvdsStreamCfg | None = None
    profile: ProfileCfg
    chirps: tuple[ChirpCfg, ...]
    frame: FrameCfg
    #: Lanes that the device writes to, where they are not those that the card takes: of four, a card that takes two
    #: gets samples 0 and 1 of every four.
    sent_lanes: int | None = None

    def __post_init__(self) -> None:
        self._require_device()
        self._require_lanes()
        self._require_chirps()
        if not self.used_chirps:
            raise ValueError(f"chirpCfg.tx_mask must name a transmitter in the horizontal row of {self.device}")
        frame_ms = 1e3 * self.frame.loops * len(self.transmitters) * self.profile.chirp_interval_s
        if frame_ms > self.frame.period_ms * (1.0 + 1e-9):
            raise ValueError(f"frameCfg.period_ms must hold all chirps, {frame_ms:g}, got {self.frame.period_ms!r}")

    @property
    def lanes(self) -> int:
        """LVDS lanes: 2 or 4."""
        return DEVICES[self.device].lanes

    @property
    def receivers(self) -> tuple[int, ...]:
        """Receivers that are switched on, from 0."""
        receivers = DEVICES[self.device].receivers
        return tuple(index for index in range(receivers) if self.channel.rx_mask >> index & 1)

    @property
    def transmitters(self) -> tuple[int, ...]:
        """Transmitter of each chirp of a loop, from 0."""
        indices = range(self.frame.chirp_start_index, self.frame.chirp_end_index + 1)
        return tuple(self._chirp_at(index).tx_mask.bit_length() - 1 for index in indices)

    @property
    def channels(self) -> tuple[tuple[int, int, int], ...]:
        """Channels of the horizontal row: chirp of a loop, receiver among those switched on, place.

        Of a place that several transmitters share, as in a cascade, the first.
        """
        row = DEVICES[self.device].row
        first: dict[int, int] = {}
        return tuple(
            (at, index, place)
            for at, transmitter in enumerate(self.transmitters)
            for index, receiver in enumerate(self.receivers)
            if (place := row[transmitter][receiver]) is not None and first.setdefault(place, transmitter) == transmitter
        )

    @property
    def used_chirps(self) -> tuple[int, ...]:
        """Chirps of a loop whose transmitter is in the horizontal row; the others measure heights, not azimuths."""
        return tuple(dict.fromkeys(at for at, _, _ in self.channels))

    @property
    def is_real(self) -> bool:
        """True where samples are real: a file has no Q."""
        return self.adc.output_format == 0

    @property
    def has_lost_lanes(self) -> bool:
        """True where the card takes two of four lanes."""
        return self.sent_lanes not in (None, self.lanes)

    @property
    def stored_samples(self) -> int:
        """Samples of a chirp in the file."""
        return self.profile.adc_samples // (2 if self.has_lost_lanes else 1)

    @property
    def samples(self) -> int:
        """Complex samples of a chirp: real ones make half as many."""
        return self.stored_samples // (2 if self.is_real else 1)

    @property
    def sample_rate_hz(self) -> float:
        """Their mean rate."""
        return 1e3 * self.profile.sample_rate_ksps * self.samples / self.profile.adc_samples

    @property
    def frame_shape(self) -> tuple[int, int, int, int]:
        """(loops, chirps of a loop, receivers, samples) in the file."""
        return self.frame.loops, len(self.transmitters), len(self.receivers), self.stored_samples

    @property
    def sample_bytes(self) -> int:
        """Bytes of a sample in the file."""
        return _BYTES_PER_CODE * (1 if self.is_real else 2)

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame in the file."""
        loops, chirps, receivers, samples = self.frame_shape
        return loops * chirps * receivers * samples * self.sample_bytes

    def _chirp_at(self, index: int) -> ChirpCfg:
        matches = [chirp for chirp in self.chirps if chirp.start_index <= index <= chirp.end_index]
        if len(matches) != 1:
            raise ValueError(f"chirpCfg must name chirp {index} of frameCfg once, got {len(matches)} times")
        return matches[0]

    def _require_device(self) -> None:
        device = DEVICES[self.device]
        _require_between("channelCfg.rx_mask", self.channel.rx_mask, 1, (1 << device.receivers) - 1)
        _require_between("profileCfg.start_frequency_ghz", self.profile.start_frequency_ghz, *device.band_ghz)
        if device.is_real and not self.is_real:
            _require_value("adcCfg.output_format", self.adc.output_format, 0, f"real, as {self.device} samples")
        if device.parts > 1 and self.is_real:
            raise ValueError(f"adcCfg.output_format must be 1 or 2 on {self.device}, got 0")
        if self.adcbuf is not None:
            expected, noun = (1, "real") if self.is_real else (0, "complex")
            _require_value("adcbufCfg.output_format", self.adcbuf.output_format, expected, noun)
        if self.is_real and (self.profile.adc_samples % 2 or self.sent_lanes is not None):
            raise ValueError(f"profileCfg.adc_samples must be even, without sent_lanes, where samples are real, "
                             f"got {self.profile.adc_samples} and {self.sent_lanes}")  # fmt: skip

    def _require_lanes(self) -> None:
        full = (1 << DEVICES[self.device].receivers) - 1
        if self.lanes == 4 and self.channel.rx_mask != full:
            raise ValueError(f"channelCfg.rx_mask must be {full} with four lanes ({self.device}), "
                             f"got {self.channel.rx_mask}")  # fmt: skip
        if self.sent_lanes not in (None, 4, self.lanes):
            raise ValueError(f"sent_lanes must be {self.lanes} on {self.device}, or 4 of which the card takes two, "
                             f"got {self.sent_lanes!r}")  # fmt: skip
        if self.has_lost_lanes and self.profile.adc_samples % 4:
            raise ValueError(f"profileCfg.adc_samples must be a multiple of 4 where two of four lanes are taken, "
                             f"got {self.profile.adc_samples}")  # fmt: skip
        if self.lanes == 2 and self.profile.adc_samples % 2:
            raise ValueError(f"profileCfg.adc_samples must be even with two lanes ({self.device}), "
                             f"got {self.profile.adc_samples}")  # fmt: skip
        expected = 0 if self.lanes == 4 else 1
        if self.adcbuf is not None and self.adcbuf.channel_interleave != expected:
            raise ValueError(f"adcbufCfg.channel_interleave must be {expected} on {self.device}, "
                             f"got {self.adcbuf.channel_interleave}")  # fmt: skip

    def _require_chirps(self) -> None:
        for index in range(self.frame.chirp_start_index, self.frame.chirp_end_index + 1):
            chirp = self._chirp_at(index)
            if chirp.profile_id != self.profile.profile_id:
                raise ValueError(f"chirpCfg.profile_id must be that of profileCfg, {self.profile.profile_id}, "
                                 f"got {chirp.profile_id}")  # fmt: skip
            on_board = chirp.tx_mask.bit_length() <= len(DEVICES[self.device].row)
            if not (on_board and chirp.tx_mask & self.channel.tx_mask):
                raise ValueError(f"chirpCfg.tx_mask must be a transmitter of {self.device} that channelCfg.tx_mask "
                                 f"{self.channel.tx_mask} switches on, got {chirp.tx_mask}")  # fmt: skip


#: Words of a line are the fields of its command, in their order.
_COMMANDS: dict[str, type[msgspec.Struct]] = {
    "channelCfg": ChannelCfg,
    "adcCfg": AdcCfg,
    "adcbufCfg": AdcbufCfg,
    "lvdsStreamCfg": LvdsStreamCfg,
    "profileCfg": ProfileCfg,
    "chirpCfg": ChirpCfg,
    "frameCfg": FrameCfg,
}
#: Commands that do not change the raw samples: detection, output, monitoring on the device.
_WITHOUT_EFFECT = frozenset(
    {
        "sensorStop", "flushCfg", "sensorStart", "lowPower", "guiMonitor", "cfarCfg", "multiObjBeamForming",
        "calibDcRangeSig", "clutterRemoval", "apllFreqShiftEn", "adcDataDitherCfg", "gpAdcMeasConfig", "cfarProcCfg",
        "aoaProcCfg", "runtimeCalibCfg", "factoryCalibCfg", "adcDataSource", "adcLogging", "lowPowerCfg",
        "compRangeBiasAndRxChanPhase", "measureRangeBiasAndRxChanPhase", "aoaFovCfg", "cfarFovCfg",
        "extendedMaxVelocity", "nearFieldCfg", "peakGrouping", "CQRxSatMonitor", "CQSigImgMonitor", "analogMonitor",
        "calibData", "configDataPort",
    }
)  # fmt: skip
#: `antGeometryCfg` of AWR2944EVM: height and place of each pair, then half wavelengths between places and heights.
_GEOMETRY = (1, 0, 1, 1, 1, 2, 1, 3, 0, 2, 0, 3, 0, 4, 0, 5, 1, 4, 1, 5, 1, 6, 1, 7, 1, 8, 1, 9, 1, 10, 1, 11, 0.5, 0.8)
#: Commands that are read only to check their values: word, value, rule.
_FIXED = {"dfeDataOutputMode": (0, 1, "frames without subframes"), "bpmCfg": (1, 0, "transmitters take turns")}


def parse_json(text: str | bytes, name: str, device: DeviceName | None = None) -> Dca1000Config:
    """Return the configuration of a JSON object; `device` is used if it does not name one.

    Raises `ValueError` that begins with `name` as `parse_cfg` does.
    """
    try:
        fields = msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{name}: must be JSON: {error}") from None
    if not isinstance(fields, dict):
        raise ValueError(f"{name}: must be a JSON object, got {type(fields).__name__}")
    return configured(fields, name, device)


def parse_cfg(text: str, name: str, device: DeviceName | None = None) -> Dca1000Config:
    """Return the configuration of TI's command-line file; the device from its "% Platform:" line unless given.

    Raises `ValueError` that begins with `name` for unknown commands, words that are no numbers or are too many, and
    settings under which the file would hold anything but complex samples of equal chirps.
    """
    fields: dict[str, Any] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        where = f"{name}: line {number}"
        if platform := re.match(r"\s*%\s*Platform:\s*(\S+)", line):
            fields["device"] = platform[1].lower()
        words = line.split("%")[0].split()
        if words:
            _add_command(fields, words[0], words[1:], where)
    return configured(fields, name, device)


def _add_command(fields: dict[str, Any], command: str, words: list[str], where: str) -> None:
    """Put a command's words under the names of its fields."""
    if command in _WITHOUT_EFFECT:
        return
    if command == "antGeometryBoard":
        board = " ".join(words).lower()
        fields.setdefault("device", "awrl6844" if board == "xwrl6844evm" else board)
        return
    values = [_number(word, f"{where}: {command}") for word in words]
    if command in _FIXED:
        at, expected, rule = _FIXED[command]
        if len(values) <= at or values[at] != expected:
            raise ValueError(f"{where}: {command} must be {expected} ({rule}), got {' '.join(words) or 'nothing'}")
    elif command == "antGeometryCfg":
        if values != list(_GEOMETRY):
            raise ValueError(f"{where}: antGeometryCfg must be that of AWR2944EVM, got {' '.join(words)}")
    elif command in L_SDK_COMMANDS and (command != "frameCfg" or "chirpComnCfg" in fields):
        _put(fields, command, l_sdk_words(command, values, where), where)
    elif command not in _COMMANDS:
        raise ValueError(f"{where}: command must be one that is known, got {command!r}")
    else:
        _put(fields, command, _parameters(_COMMANDS[command], command, values, where), where)


def _put(fields: dict[str, Any], command: str, values: dict[str, Any], where: str) -> None:
    if command == "chirpCfg":
        fields.setdefault(command, []).append(values)
    elif command in fields:
        raise ValueError(f"{where}: {command} must stand once, got it again")
    else:
        fields[command] = values


def _parameters(kind: type[msgspec.Struct], command: str, values: list[float], where: str) -> dict[str, Any]:
    names = kind.__struct_fields__
    # SDK 1 has no subframes
    if command == "adcbufCfg" and len(values) == len(names) - 1:
        values = [-1, *values]
    # SDKs of AWR2944 add the samples to the frame, and two words on a clock to the channels
    if command == "frameCfg" and len(values) == len(names) + 1:
        values = [*values[:4], *values[5:]]
    if command == "channelCfg" and len(values) == len(names) + 2:
        values = values[:-2]
    if len(values) != len(names):
        raise ValueError(f"{where}: {command} must have {len(names)} numbers ({', '.join(names)}), got {len(values)}")
    return dict(zip(names, values, strict=True))


def _number(word: str, where: str) -> float:
    for kind in (int, float):
        try:
            return kind(word)
        except ValueError:
            continue
    raise ValueError(f"{where} must have numbers, got {word!r}")


def configured(fields: dict[str, Any], name: str, device: DeviceName | None) -> Dca1000Config:
    """Return the configuration of commands by their names; raises `ValueError` that begins with `name`."""
    device_name = fields.get("device", device)
    if device_name is None:
        raise ValueError(f"{name}: device must be named, one of {', '.join(DEVICES)}: the lanes depend on it")
    if device not in (None, device_name):
        raise ValueError(f"{name}: device must be {device} as asked for, got {device_name!r}")
    if "chirpComnCfg" in fields:
        fields = l_sdk_fields(fields, name)
    try:
        return msgspec.convert({**fields, "device": device_name}, Dca1000Config)
    except msgspec.ValidationError as error:
        raise ValueError(f"{name}: {with_known_names(error, Dca1000Config)}{value_at(fields, str(error))}") from None


def value_at(fields: dict[str, Any], message: str) -> str:
    """Return the single value that a message of msgspec is about; its own messages do not include it."""
    path = re.search(r"`\$\.([^`]*)`$", message)
    value: Any = fields
    for key in re.findall(r"\w+", path[1]) if path else ():
        value = value[int(key)] if isinstance(value, list) else value.get(key)
    return "" if isinstance(value, dict | list) or value is None else f", got {value!r}"


class FileFrames(NamedTuple):
    """Frames of a file: whole ones, number that the configuration asks for (None: any), bytes past the last."""

    whole: int
    wanted: int | None
    left_bytes: int
    #: The card took two of four lanes.
    has_lost_lanes: bool = False

    @property
    def loss(self) -> str | None:
        """Description of what is missing; None if the file is complete."""
        verb = "is" if self.left_bytes == 1 else "are"
        cut = f", {counted(self.left_bytes, 'byte')} of one that is cut {verb} left out"
        partial = cut if self.left_bytes else ""
        lanes = "two of four lanes were not taken, so that only the nearer half of the ranges is unambiguous"
        if self.wanted is not None and self.whole < self.wanted:
            partial = f"whole frames: {self.whole} of {self.wanted}{partial}"
        elif partial:
            partial = f"whole frames: {self.whole}{partial}"
        return "; ".join([partial] * bool(partial) + [lanes] * self.has_lost_lanes) or None


def frames_of(size_bytes: int, config: Dca1000Config, name: str) -> FileFrames:
    """Return the whole frames of a file of this size; raises `ValueError` without any, or with more than configured."""
    wanted = config.frame.frames or None
    if wanted is not None and size_bytes > wanted * config.frame_bytes:
        loops, chirps, receivers, samples = config.frame_shape
        raise ValueError(
            f"{name}: size must be at most {wanted * config.frame_bytes} bytes ({wanted} frames x {loops} loops x "
            f"{chirps} chirps x {receivers} receivers x {samples} samples x {config.sample_bytes}), got {size_bytes}"
        )
    whole, left = divmod(size_bytes, config.frame_bytes)
    if not whole:
        raise ValueError(f"{name}: must hold a whole frame of {config.frame_bytes} bytes, got {size_bytes}")
    return FileFrames(whole, wanted, left, config.has_lost_lanes)


def frame_samples(codes: np.ndarray, config: Dca1000Config) -> np.ndarray:
    """Return samples complex64 [loops, channels, samples] of one frame, int16 [frame_bytes / 2] as the file has it.

    Channels are those of `array_params`: chirp by chirp of the horizontal row, receiver by receiver.
    """
    require_array("codes", codes, "<i2", (config.frame_bytes // 2,))
    first, second = _parts(codes, config)
    swapped = config.adcbuf is not None and config.adcbuf.sample_swap
    real, imaginary = (second, first) if swapped else (first, second)
    values = np.empty(config.frame_shape, np.complex64)
    values.real, values.imag = real, imaginary
    chirps, receivers, _ = (list(each) for each in zip(*config.channels, strict=True))
    used = values[:, chirps, receivers]
    if turned := DEVICES[config.device].turned:
        signs = [-1.0 if config.transmitters[at] in turned else 1.0 for at in chirps]
        used *= np.array(signs, np.float32)[:, None]
    if config.is_real:
        return analytic(used)
    return _evenly(used) if config.has_lost_lanes else used


def analytic(real: np.ndarray) -> np.ndarray:
    """Return the complex samples [..., samples / 2] of real ones, complex64 [..., samples]: the upper half of a real
    spectrum repeats the lower one. A real tone of amplitude one becomes a complex one.

    The window on the way, taken off again, keeps a tone between the bins from leaking over the cut: 56 dB under it.
    """
    count = real.shape[-1]
    window = (_PEDESTAL + (1.0 - _PEDESTAL) * np.sin(np.pi * np.arange(count) / count) ** 2).astype(np.float32)
    lower = scipy.fft.fft(real * window, axis=-1, workers=1)[..., : count // 2]
    return np.asarray(scipy.fft.ifft(lower, axis=-1, workers=1) / window[::2])


def _evenly(stored: np.ndarray) -> np.ndarray:
    """Return samples 0, 2, 4, 6, ... of chirps, complex64 [..., samples], from samples 0, 1, 4, 5, 8, 9, ...

    Samples 0, 4, ... and 1, 5, ... each fold the lower half of the spectrum once, with factors 1 and j on its upper
    part, which gives both parts. Exact for tones on bins of that half; noise rises by 3 dB, and echoes of the upper
    half come out in the lower.
    """
    half = stored.shape[-1] // 2
    turned = np.exp(-2j * np.pi * np.arange(half) / (4 * half)).astype(np.complex64)
    first = scipy.fft.fft(stored[..., 0::2], workers=1)
    upper = (scipy.fft.fft(stored[..., 1::2], workers=1) * turned - first) / np.complex64(1j - 1.0)
    return np.asarray(2.0 * scipy.fft.ifft(np.concatenate([first - upper, upper], axis=-1), workers=1))


def _parts(codes: np.ndarray, config: Dca1000Config) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and second part of each sample, int16 [loops, chirps, receivers, samples] each."""
    loops, chirps, receivers, samples = config.frame_shape
    if (parts := DEVICES[config.device].parts) > 1:
        # [device, ..., sample, receiver, I or Q]
        cube = codes.reshape(parts, loops, chirps, samples, receivers // parts, 2)
        first, second = np.moveaxis(cube, 5, 0).transpose(0, 2, 3, 1, 5, 4).reshape(2, *config.frame_shape)
        return first, second
    if config.is_real:
        by_receiver = (loops, chirps, receivers, samples)
        by_sample = (loops, chirps, samples, receivers)
        cube = codes.reshape(by_sample).swapaxes(2, 3) if config.lanes == 4 else codes.reshape(by_receiver)
        return cube, np.zeros_like(cube)
    if config.lanes == 4:
        # [..., sample, I or Q, receiver]
        cube = codes.reshape(loops, chirps, samples, 2, receivers).transpose(3, 0, 1, 4, 2)
        return cube[0], cube[1]
    # [..., receiver, pair of samples, I or Q, index in the pair]
    pairs = codes.reshape(loops, chirps, receivers, samples // 2, 2, 2)
    return pairs[..., 0, :].reshape(config.frame_shape), pairs[..., 1, :].reshape(config.frame_shape)


def array_params(config: Dca1000Config, remove_static: bool = False, mirrored: bool = False) -> DigitalArrayParams:
    """Return the digital array of a capture; powers are relative: a tone of amplitude one code has one milliwatt.

    `mirrored`: receivers run to the right as the radar looks, not to the left.
    """
    chirps = len(config.transmitters)
    half_m = 0.5 * SPEED_OF_LIGHT_MPS / config.profile.middle_hz * (-1.0 if mirrored else 1.0)
    # counted so that the last slot is used: the array takes a loop for as long as its last channel's slot
    shift = chirps - 1 - max(config.used_chirps)
    return DigitalArrayParams(
        carrier_hz=config.profile.middle_hz,
        chirp_slope_hz_per_s=1e12 * config.profile.slope_mhz_per_us,
        sample_rate_hz=config.sample_rate_hz,
        chirp_interval_s=config.profile.chirp_interval_s,
        channel_slot=tuple(at + shift for at, _, _ in config.channels),
        channel_y_m=tuple(half_m * place for _, _, place in config.channels),
        remove_static=remove_static,
    )


def map_grid(config: Dca1000Config) -> RangeAzimuthGrid:
    """Return the grid of the capture's maps: 256 azimuths over +-60 deg; half of the range bins with an image band."""
    range_bin_m = array_params(config).range_bin_m(config.samples)
    return RangeAzimuthGrid(range_bin_m=range_bin_m, range_bins=config.samples // max(1, config.adc.output_format))
