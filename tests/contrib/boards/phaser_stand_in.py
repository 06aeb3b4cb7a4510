"""A Phaser kit without hardware: the real classes of pyadi-iio on a libiio that only knows a simulated kit.

Every write goes through the library's own code and ends at an attribute that the library itself names, so a name that
the library does not have, an order that has no effect or an unlatched phase shows as it would on a bench. The kit
answers with closed-form beats of point targets, in converter codes, from what has been written to it by then: ramp,
timing, tone, gains, latched phases. What a real board does beyond that is not here.
"""

from __future__ import annotations

import errno
import importlib
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from msgs.values.units import SPEED_OF_LIGHT_MPS

BOARD_URI, CONVERTER_URI = "ip:board.test", "ip:converter.test"
SPACING_M = 0.015
#: Which element stands behind each channel of the two chips.
WIRING = {"BEAM0": (7, 8, 5, 6), "BEAM1": (3, 4, 1, 2)}
_CHANNEL = "attenuation beam_pos_load powerdown hardwaregain phase bias_set_load pa_bias_on pa_bias_off detector_en raw"
_CHIP = (
    "label beam_mem_enable bias_mem_enable common_mem_enable sequencer_enable rx_load_spi tx_load_spi reset tr_source"
    " tr_spi sw_drv_en_pol sw_drv_en_tr sw_drv_tr_mode_sel sw_drv_tr_state pol rx_en tx_en rx_lna_enable rx_vga_enable"
    " rx_vm_enable tx_drv_enable tx_vga_enable tx_vm_enable bias_current_rx bias_current_rx_lna bias_current_tx"
    " bias_current_tx_drv lna_bias_on lna_bias_off lna_bias_out_enable bias_ctrl bias_enable external"
)
_RAMP = (
    "frequency frequency_deviation_range frequency_deviation_step frequency_deviation_time powerdown ramp_mode"
    " ramp_mode_available"
)
_RAMP_DEBUG = (
    "adi,phase adi,txdata-trigger-delay-enable adi,single-full-triangle-enable adi,txdata-trigger-enable"
    " adi,ramp-delay-enable adi,delay-clk-sel-pfd-x-clk1-enable adi,delay-start-enable adi,delay-start-word"
    " adi,clk-div-mode adi,ramp-enable adi,clk1-div adi,clk2-timer-div adi,muxout-select"
)
_RAMP_MODES = "disabled continuous_sawtooth continuous_triangular single_sawtooth_burst single_ramp_burst"
_TIMING = (
    "frame_length_ms frame_length_raw startup_delay_ms startup_delay_raw internal_sync_period_ms burst_count sync_soft"
    " sync_external sync_internal sync_reset enable state"
)
_BOARD_PINS = (
    "vctrl_1", "vctrl_2", "div_mr", "div_s0", "div_s1", "div_s2", "rx_load", "tr", "tx_sw", "muxout", "burst"
)  # fmt: skip
_PHY = "hardwaregain gain_control_mode rf_bandwidth sampling_frequency quadrature_tracking_en"


class Attribute:
    """One attribute of libiio: text, read and written over a link that may be down."""

    def __init__(self, kit: StandInKit, text: str, on_write: Any = None) -> None:
        self._kit, self._text, self._on_write = kit, text, on_write

    @property
    def value(self) -> str:
        self._kit.touch()
        return self._text

    @value.setter
    def value(self, text: str) -> None:
        self._kit.touch()
        assert isinstance(text, str)
        self._text = text
        if self._on_write is not None:
            self._on_write(text)


class Part:
    """A device or a channel: attributes by name, no others."""

    def __init__(self, kit: StandInKit, name: str, attributes: str = "", **texts: str) -> None:
        self.name = self.id = self._id = name
        self.attrs = {key: Attribute(kit, texts.get(key, "0")) for key in attributes.split()}
        self.output = False
        self.enabled = False
        self.scan_element = True


class Channel(Part):
    """A channel; those of converters are read as int16."""

    data_format = types.SimpleNamespace(is_signed=True, length=16, is_be=False)

    def read(self, buffer: Buffer) -> bytes:
        return buffer.channels[self.id].astype("<i2").tobytes()


class Device(Part):
    """A device with channels."""

    def __init__(self, kit: StandInKit, name: str, attributes: str = "", label: str = "", **texts: str) -> None:
        super().__init__(kit, name, attributes, **({"label": label} if label else {}), **texts)
        self.kit, self.label = kit, label
        self.channels: list[Channel] = []
        self.debug_attrs: dict[str, Attribute] = {}
        self.registers: dict[int, int] = {}

    def add(self, names: str, attributes: str, output: bool, **texts: str) -> Device:
        for name in names.split():
            channel = Channel(self.kit, name, attributes, **texts)
            channel.output = output
            self.channels.append(channel)
        return self

    def find_channel(self, name: str, is_output: bool = False) -> Channel | None:
        return next((one for one in self.channels if one.id == name and one.output == is_output), None)

    def reg_write(self, register: int, value: int) -> None:
        self.kit.touch()
        self.registers[register] = value

    def set_kernel_buffers_count(self, count: int) -> None:
        assert count > 0


class Context:
    """What `iio.Context(uri)` finds."""

    kit: StandInKit

    def __init__(self, uri: str) -> None:
        self.kit.touch()
        self.devices = self.kit.devices_at(uri)

    def find_device(self, name: str) -> Device | None:
        return next((one for one in self.devices if one.name == name), None)

    def set_timeout(self, timeout_ms: int) -> None:
        assert timeout_ms > 0


class Buffer:
    """A buffer of samples, receive or transmit."""

    def __init__(self, device: Device, samples: int, cyclic: bool) -> None:
        self._device, self._samples, self.cyclic = device, samples, cyclic
        self.channels: dict[str, np.ndarray] = {}

    def refill(self) -> None:
        burst = self._device.kit.burst(self._samples)
        self.channels = {f"voltage{2 * c + q}": (z.real, z.imag)[q] for c, z in enumerate(burst) for q in (0, 1)}

    def write(self, data: bytearray) -> None:
        codes = np.frombuffer(bytes(data), "<i2").reshape(-1, 2, 2)
        self._device.kit.tones = codes[..., 0] + 1j * codes[..., 1]

    def push(self) -> None:
        assert self.cyclic


class StandInKit:
    """The kit: what was written to it, and what it measures of point targets (range_m, azimuth_deg, codes)."""

    def __init__(
        self,
        targets: tuple[tuple[float, float, float], ...] = ((12.0, 20.0, 4.0),),
        element_gains: np.ndarray | None = None,
        element_phases_deg: np.ndarray | None = None,
        noise_codes: float = 1.0,
        seed: int = 0,
    ) -> None:
        self.targets, self.noise_codes = targets, noise_codes
        gains = np.ones(8) if element_gains is None else element_gains
        phases_deg = np.zeros(8) if element_phases_deg is None else element_phases_deg
        #: What each element does to the field by itself, elements 1..8 from right to left.
        self.elements = gains * np.exp(1j * np.radians(phases_deg))
        self.latched = np.zeros(8, complex)
        self.tones = np.zeros((0, 2), complex)
        self.reachable = True
        #: It answers, but no pulse starts a burst.
        self.deaf = False
        self.triggered = False
        self.short = False
        self.bursts = self.touches = 0
        self._rng = np.random.default_rng(seed)
        self._pulse = 0
        self._build()

    def _build(self) -> None:
        def pins(*labels: str) -> Device:
            device = Device(self, "one-bit-adc-dac", "label", label="one-bit-adc-dac")
            for at, label in enumerate(labels):
                device.add(f"voltage{at}", "label raw", True, label=label)
            return device

        self.ramp = Device(self, "adf4159").add("altvoltage0", _RAMP, True, ramp_mode_available=_RAMP_MODES)
        self.ramp.debug_attrs = {name: Attribute(self, "0") for name in _RAMP_DEBUG.split()}
        self.chips = [Device(self, "adar1000", _CHIP, label=label) for label in WIRING]
        for chip in self.chips:
            for output in (False, True):
                chip.add("voltage0 voltage1 voltage2 voltage3", _CHANNEL, output)
            chip.attrs["rx_load_spi"] = Attribute(self, "0", lambda text, chip=chip: self._latch(chip))
        board_pins = pins(*_BOARD_PINS)
        board_pins.channels[-1].attrs["raw"] = Attribute(self, "0", self._on_pulse)
        monitor = Device(self, "ad7291").add("temp0 " + " ".join(f"voltage{i}" for i in range(8)), "raw scale", False)
        self.timing = Device(self, "iio-axi-tdd-0", _TIMING)
        self.timing.add("channel0 channel1 channel2", "enable polarity on_ms on_raw off_ms off_raw", True)
        self.phy = Device(self, "ad9361-phy", "filter_fir_config tx_path_rates", tx_path_rates="a b:1 c d e f:1")
        self.phy.add("voltage0 voltage1", _PHY, False, sampling_frequency="30720000")
        self.phy.add("voltage0 voltage1", _PHY, True).add("out", "voltage_filter_fir_en", False)
        self.phy.add("altvoltage0 altvoltage1", "frequency powerdown", True)
        receive, transmit = Device(self, "cf-ad9361-lpc"), Device(self, "cf-ad9361-dds-core-lpc")
        receive.add("voltage0 voltage1 voltage2 voltage3", "", False)
        transmit.add("voltage0 voltage1 voltage2 voltage3", "", True)
        transmit.add(" ".join(f"altvoltage{i}" for i in range(8)), "raw frequency scale phase", True)
        self.pins = pins("tdd_ext_sync", "phaser_enable")
        self._devices = {
            BOARD_URI: [self.ramp, *self.chips, board_pins, monitor],
            CONVERTER_URI: [self.phy, receive, transmit, self.timing, self.pins],
        }

    def touch(self) -> None:
        """Every word to the kit goes over the link."""
        self.touches += 1
        if not self.reachable:
            raise OSError(errno.EHOSTUNREACH, "No route to host")

    def devices_at(self, uri: str) -> list[Device]:
        if uri not in self._devices:
            raise OSError(errno.ENOENT, "no such context")
        return self._devices[uri]

    def _latch(self, chip: Device) -> None:
        for channel, element in zip(chip.channels, WIRING[chip.label], strict=False):
            phase_deg = round(float(channel.attrs["phase"].value) / 2.8125) * 2.8125
            gain = int(channel.attrs["hardwaregain"].value) / 127.0
            self.latched[element - 1] = gain * np.exp(1j * np.radians(phase_deg))

    def _on_pulse(self, text: str) -> None:
        self.triggered |= self._pulse == 0 and int(text) == 1 and not self.deaf
        self._pulse = int(text)

    def _number(self, device: Device, channel: str, name: str, output: bool = True) -> float:
        found = device.find_channel(channel, output)
        assert found is not None
        return float(found.attrs[name].value)

    def burst(self, samples: int) -> list[np.ndarray]:
        """Both channels' converter codes of one triggered burst, four elements a channel; complex [samples]."""
        self.touch()
        is_on = self.timing.attrs["enable"].value == "1" and self.pins.channels[0].attrs["raw"].value == "1"
        if not (self.triggered and is_on):
            raise OSError(errno.ETIMEDOUT, "Connection timed out")
        self.triggered = False
        self.bursts += 1
        rate_hz = self._number(self.phy, "voltage0", "sampling_frequency", False)
        chirps = int(self.timing.attrs["burst_count"].value)
        interval = round(1e-3 * float(self.timing.attrs["frame_length_ms"].value) * rate_hz)
        fields = [self._chirp(half, np.arange(interval) / rate_hz) for half in (slice(0, 4), slice(4, 8))]
        out = [np.resize(np.tile(field, chirps), samples) for field in fields]
        noise = self._rng.normal(scale=self.noise_codes, size=(2, samples, 2)) @ (1.0, 1j)
        codes = [
            np.clip(np.rint(z.real), -2048, 2047) + 1j * np.clip(np.rint(z.imag), -2048, 2047) for z in out + noise
        ]
        return [z[: samples // 2] for z in codes] if self.short else codes

    def _chirp(self, half: slice, time_s: np.ndarray) -> np.ndarray:
        """What four elements receive from the start of a ramp to that of the next; complex [samples]."""
        if self._number(self.ramp, "altvoltage0", "powerdown"):
            return np.zeros(len(time_s), complex)
        tone_hz = self._tone_hz()
        swept_hz = 4.0 * self._number(self.ramp, "altvoltage0", "frequency_deviation_range")
        slope = swept_hz / (1e-6 * self._number(self.ramp, "altvoltage0", "frequency_deviation_time"))
        oscillator_hz = 4.0 * self._number(self.ramp, "altvoltage0", "frequency")
        start_hz = oscillator_hz - self._number(self.phy, "altvoltage1", "frequency") - tone_hz
        place_m = SPACING_M * (np.arange(8) - 3.5)[half]
        result = np.zeros(len(time_s), complex)
        for range_m, azimuth_deg, codes in self.targets:
            delay_s = 2.0 * range_m / SPEED_OF_LIGHT_MPS
            middle_hz = start_hz + 0.5 * swept_hz
            field = np.exp(2j * np.pi * middle_hz / SPEED_OF_LIGHT_MPS * place_m * np.sin(np.radians(azimuth_deg)))
            # the oscillator is above the band: the beat carries the conjugate of the field
            received = np.conj((self.elements * self.latched)[half] @ field)
            turns = (tone_hz + slope * delay_s) * time_s + start_hz * delay_s - 0.5 * slope * delay_s**2
            result += codes * received * np.exp(2j * np.pi * (turns % 1.0))
        return result

    def _tone_hz(self) -> float:
        """Frequency of the tone on the second output, from the samples that were written."""
        tone = self.tones[:, 1]
        rate_hz = self._number(self.phy, "voltage0", "sampling_frequency", False)
        return float(np.fft.fftfreq(len(tone), 1.0 / rate_hz)[np.argmax(np.abs(np.fft.fft(tone)))])


class Strict:
    """A library object that refuses to be given attributes which its class does not have."""

    def __init__(self, inner: Any) -> None:
        object.__setattr__(self, "_inner", inner)

    def __getattr__(self, name: str) -> Any:
        return _strict(getattr(self._inner, name))

    def __setattr__(self, name: str, value: Any) -> None:
        if not hasattr(self._inner, name):
            raise AttributeError(f"{self._inner!r} has no attribute {name!r}")
        setattr(self._inner, name, value)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return _strict(self._inner(*args, **kwargs))


def _strict(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_strict(item) for item in value]
    kind = value if isinstance(value, type) else type(value)
    is_library = kind.__module__.split(".")[0] == "adi" or isinstance(value, types.MethodType)
    return Strict(value) if is_library else value


@contextmanager
def library_on(kit: StandInKit) -> Iterator[Any]:
    """pyadi-iio as installed, on a libiio that knows `kit` alone; the process's own modules come back afterwards."""
    iio = types.ModuleType("iio")
    context = type("Context", (Context,), {"kit": kit})
    parts = {"Context": context, "Device": Device, "Channel": Channel, "Buffer": Buffer, "ChannelAttr": Attribute}
    vars(iio).update(parts, version=(0, 26, "stand-in"), scan_contexts=dict)
    own = {name: module for name, module in sys.modules.items() if name.split(".")[0] in ("iio", "adi")}
    for name in own:
        del sys.modules[name]
    sys.modules["iio"] = iio
    try:
        library = importlib.import_module("adi")
        importlib.import_module("adi.cn0566").sleep = lambda seconds: None  # type: ignore[attr-defined]
        yield Strict(library)
    finally:
        for name in [name for name in sys.modules if name.split(".")[0] in ("iio", "adi")]:
            del sys.modules[name]
        sys.modules.update(own)
