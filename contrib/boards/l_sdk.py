"""Chirps of TI's low-power radars (AWRL6844) by the commands of their SDK, as those of the others.

`chirpComnCfg`, `chirpTimingCfg` and `frameCfg` describe all chirps at once; transmitters take turns. Source: TI's
MMWAVE-L-SDK; the sample rate is 200 MHz over the word of `chirpComnCfg`.
"""

from __future__ import annotations

from typing import Any

#: Words of each command.
L_SDK_COMMANDS = {
    "chirpComnCfg": ("rate_word", "bits", "filter", "adc_samples", "pattern", "ramp_end_us", "high_pass"),
    "chirpTimingCfg": ("idle_us", "skipped_samples", "tx_start_us", "slope", "start_ghz"),
    "frameCfg": ("burst_chirps", "accumulated", "burst_us", "bursts", "period_ms", "frames"),
}
_TRANSMITTERS, _RECEIVERS = 4, 4
_CLOCK_KSPS = 200_000.0
#: Masks that switch on all channels: two bits each.
_ALL = (153, 255)


def l_sdk_words(command: str, values: list[float], where: str) -> dict[str, float]:
    """Return the words of a command by their names; `ValueError` where there are more or fewer."""
    names = L_SDK_COMMANDS[command]
    if len(values) != len(names):
        raise ValueError(f"{where}: {command} must have {len(names)} numbers ({', '.join(names)}), got {len(values)}")
    return dict(zip(names, values, strict=True))


def l_sdk_fields(fields: dict[str, Any], name: str) -> dict[str, Any]:
    """Return the fields of a configuration of the other devices; `ValueError` that begins with `name`."""
    for command in ("channelCfg", *L_SDK_COMMANDS):
        if command not in fields:
            raise ValueError(f"{name}: {command} must be given")
    channel, common = fields["channelCfg"], fields["chirpComnCfg"]
    timing, frame = fields["chirpTimingCfg"], fields["frameCfg"]
    for place, value, expected in (
        ("channelCfg.rx_mask", channel["rx_mask"], _ALL[0]),
        ("channelCfg.tx_mask", channel["tx_mask"], _ALL[1]),
        ("chirpComnCfg.pattern", common["pattern"], 1),
        ("frameCfg.accumulated", frame["accumulated"], 0),
        ("frameCfg.bursts", frame["bursts"], 1),
    ):
        if value != expected:
            raise ValueError(f"{name}: {place} must be {expected} (all in turn, evenly), got {value:g}")
    if common["rate_word"] <= 0 or frame["burst_chirps"] % _TRANSMITTERS:
        raise ValueError(
            f"{name}: frameCfg.burst_chirps must be a multiple of {_TRANSMITTERS} and chirpComnCfg.rate_word positive, "
            f"got {frame['burst_chirps']:g} and {common['rate_word']:g}"
        )
    rate_ksps = _CLOCK_KSPS / common["rate_word"]
    profile = {
        "profile_id": 0, "start_frequency_ghz": timing["start_ghz"], "idle_time_us": timing["idle_us"],
        "adc_start_time_us": 1e3 * timing["skipped_samples"] / rate_ksps, "ramp_end_time_us": common["ramp_end_us"],
        "tx_backoff": 0, "tx_phase_shifter": 0, "slope_mhz_per_us": timing["slope"],
        "tx_start_time_us": timing["tx_start_us"], "adc_samples": common["adc_samples"], "sample_rate_ksps": rate_ksps,
        "hpf_corner_1": 0, "hpf_corner_2": 0, "rx_gain_db": 0,
    }  # fmt: skip
    chirps = [{"start_index": at, "end_index": at, "profile_id": 0, "tx_mask": 1 << at} for at in range(_TRANSMITTERS)]
    return {
        "device": fields.get("device"),
        "channelCfg": {"rx_mask": (1 << _RECEIVERS) - 1, "tx_mask": (1 << _TRANSMITTERS) - 1},
        "adcCfg": {"adc_bits": 2, "output_format": 0},
        "profileCfg": profile,
        "chirpCfg": chirps,
        "frameCfg": {
            "chirp_start_index": 0, "chirp_end_index": _TRANSMITTERS - 1,
            "loops": frame["burst_chirps"] // _TRANSMITTERS, "frames": frame["frames"], "period_ms": frame["period_ms"],
        },
    }  # fmt: skip
