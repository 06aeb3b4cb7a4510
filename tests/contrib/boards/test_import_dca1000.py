"""`mirrorwave import dca1000`: analytic points in both layouts, cut files, wrong configurations, a real capture."""

from __future__ import annotations

import hashlib
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from contrib.boards.dca1000_capture import frame_samples, parse_cfg, parse_json
from mirrorwave.cli import main
from models.perception.find.cfar import CfarParams, detect
from models.perception.form.ra_former import RaFormer
from msgs.recording.mcap import RecordingReader
from msgs.values.radar import RadarSetup, RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS
from tests.builders import example_map
from tests.captures import DATA, needs

TASK3 = DATA / "awr1843_com405_task3"
AWR = DATA / "awr_77ghz_openradar" / "doppler_example_1.npy"
LOOPS, SAMPLES = 32, 64
#: Two transmitters of a row, 2 wavelengths apart; chirps 0 and 1 in turn.
CFG = f"""% Platform:xWR16xx
sensorStop
flushCfg
dfeDataOutputMode 1
channelCfg 15 3 0
adcCfg 2 1
adcbufCfg -1 0 0 1 1
profileCfg 0 77.0 30 6 62 0 0 60 1 {SAMPLES} 2500 0 0 30
chirpCfg 0 0 0 0 0 0 0 1
chirpCfg 1 1 0 0 0 0 0 2
frameCfg 0 1 {LOOPS} 2 40 1 0
lvdsStreamCfg -1 0 1 0
guiMonitor -1 1 1 0 0 0 1 % of no account here
sensorStart
"""
CFG_14 = (
    CFG.replace("xWR16xx", "xWR14xx")
    .replace("adcbufCfg -1 0 0 1 1", "adcbufCfg 0 0 0 1")
    .replace("channelCfg 15 3 0", "channelCfg 15 5 0")
    .replace("0 0 0 0 0 2\n", "0 0 0 0 0 4\n")
)
RANGE_M, SPEED_MPS, AZIMUTH_DEG = 3.0, 1.0, 20.0
CHIRP_S, CARRIER_HZ = 92e-6, 77e9 + 60e12 * (6e-6 + 0.5 * SAMPLES / 2.5e6)


def point(transmitter_y_half: tuple[int, ...] = (0, 4), speed_mps: float = SPEED_MPS, loops: int = LOOPS) -> np.ndarray:
    """A closing point of 1000 codes, complex128 [loops, chirps, receivers, samples]; written without the program."""
    loop, chirp, receiver, sample = np.ogrid[:loops, : len(transmitter_y_half), :4, :SAMPLES]
    time_s = (loop * len(transmitter_y_half) + chirp) * CHIRP_S
    beat_hz = 2.0 * 60e12 * RANGE_M / SPEED_OF_LIGHT_MPS
    places = np.array(transmitter_y_half)[chirp] + receiver
    turns = beat_hz * sample / 2.5e6 - 2.0 * speed_mps * time_s * CARRIER_HZ / SPEED_OF_LIGHT_MPS
    return 1000.0 * np.exp(2j * np.pi * (turns - 0.5 * places * np.sin(np.radians(AZIMUTH_DEG))))


def two_lanes(cube: np.ndarray, q_first: bool = False) -> bytes:
    """I0 I1 Q0 Q1 of each pair of samples, receiver after receiver."""
    real, imag = (np.rint(part).astype("<i2") for part in (cube.real, cube.imag))
    first, second = (imag, real) if q_first else (real, imag)
    words = [first[..., 0::2], first[..., 1::2], second[..., 0::2], second[..., 1::2]]
    return np.stack(words, axis=-1).tobytes()


def four_lanes(cube: np.ndarray) -> bytes:
    """I of four receivers, then their Q, sample after sample."""
    by_sample = np.moveaxis(cube, 2, 3)
    return np.concatenate([np.rint(by_sample.real), np.rint(by_sample.imag)], axis=-1).astype("<i2").tobytes()


def real_lanes(cube: np.ndarray) -> bytes:
    """Real samples of a receiver, one after the other, receiver after receiver."""
    return np.rint(cube.real).astype("<i2").tobytes()


def real_four_lanes(cube: np.ndarray) -> bytes:
    """Real samples of four receivers, one time after the other."""
    return real_lanes(np.moveaxis(cube, 2, 3))


CFG_REAL = CFG.replace("adcCfg 2 1", "adcCfg 2 0").replace("adcbufCfg -1 0 0 1 1", "adcbufCfg -1 1 0 1 1")
#: Of an AWR2944, as its SDK's demo sends it: the second of four transmitters is higher.
CFG_2944 = (
    CFG_REAL.replace("xWR16xx", "AWR2944")
    .replace("channelCfg 15 3 0", "channelCfg 15 15 0 0 0")
    .replace("adcbufCfg -1 1 0 1 1", "adcbufCfg -1 1 1 1 1")
    .replace("frameCfg 0 1 32 2 40 1 0", f"frameCfg 0 3 32 2 {SAMPLES} 40 1 0")
    .replace("0 0 0 0 0 2\n", "0 0 0 0 0 2\nchirpCfg 2 2 0 0 0 0 0 4\nchirpCfg 3 3 0 0 0 0 0 8\n")
    + "antGeometryCfg 1 0 1 1 1 2 1 3 0 2 0 3 0 4 0 5 1 4 1 5 1 6 1 7 1 8 1 9 1 10 1 11 0.5 0.8\n"
)
#: Of an AWRL6844, by the commands of its SDK: 2.5 Msps, 20 samples (8 us) skipped, chirps 92 us apart, all at 60 GHz.
CFG_6844 = f"""antGeometryBoard xWRL6844EVM
channelCfg 153 255 0
apllFreqShiftEn 0
chirpComnCfg 80 0 0 {SAMPLES} 1 62 0
chirpTimingCfg 30 20 1 60 60
frameCfg {4 * LOOPS} 0 11776 1 40 2
adcLogging 1
sensorStart 0 0 0 0
"""
CARRIER_6844_HZ = 60e9 + 60e12 * (8e-6 + 0.5 * SAMPLES / 2.5e6)
#: Places of (transmitter, receiver) of the AWRL6844's highest row; its second and fourth transmitters are turned.
ROW_6844 = {(1, 0): 0, (1, 3): 1, (0, 0): 2, (0, 3): 3}
CASCADE_TX = (11, 10, 9, 32, 28, 24, 20, 16, 12, 8, 4, 0)
CASCADE_RX = (11, 12, 13, 14, 50, 51, 52, 53, 46, 47, 48, 49, 0, 1, 2, 3)


def l_sdk_capture() -> bytes:
    loop, chirp, receiver, sample = np.ogrid[:LOOPS, :4, :4, :SAMPLES]
    noise = 300.0 * np.random.default_rng(1).standard_normal((LOOPS, 4, 4, SAMPLES))
    places = np.array([[ROW_6844.get((tx, rx), 0) for rx in range(4)] for tx in range(4)])
    known = np.array([[(tx, rx) in ROW_6844 for rx in range(4)] for tx in range(4)])
    sign = np.array([1.0, -1.0, 1.0, -1.0])[chirp]
    turns = 2.0 * 60e12 * RANGE_M / SPEED_OF_LIGHT_MPS * sample / 2.5e6
    turns = turns - 2.0 * SPEED_MPS * (loop * 4 + chirp) * CHIRP_S * CARRIER_6844_HZ / SPEED_OF_LIGHT_MPS
    turns = turns - 0.5 * places[chirp, receiver] * np.sin(np.radians(AZIMUTH_DEG))
    point = sign * 1000.0 * np.cos(2.0 * np.pi * turns)
    return real_lanes(np.where(known[chirp, receiver], point, noise) + 0j)


def cascade_json(**changed: Any) -> str:
    """All twelve transmitters in turn, 8 loops: the first three are higher."""
    chirps = [{"start_index": at, "end_index": at, "profile_id": 0, "tx_mask": 1 << (11 - at)} for at in range(12)]
    fields = as_json_config("awr2243_cascade") | {
        "channelCfg": {"rx_mask": 0xFFFF, "tx_mask": 0xFFF}, "chirpCfg": chirps,
        "frameCfg": {"chirp_start_index": 0, "chirp_end_index": 11, "loops": 8, "frames": 2, "period_ms": 40},
    }  # fmt: skip
    return json.dumps(fields | changed)


def cascade_files(folder: Path) -> list[Path]:
    """Files of the four devices, two frames: receiver after receiver, I and Q, sample after sample."""
    loop, chirp, receiver, sample = np.ogrid[:8, :12, :16, :SAMPLES]
    places = np.array(CASCADE_TX)[11 - chirp] + np.array(CASCADE_RX)[receiver]
    turns = 2.0 * 60e12 * RANGE_M / SPEED_OF_LIGHT_MPS * sample / 2.5e6
    turns = turns - 2.0 * SPEED_MPS * (loop * 12 + chirp) * CHIRP_S * CARRIER_HZ / SPEED_OF_LIGHT_MPS
    cube = 1000.0 * np.exp(2j * np.pi * (turns - 0.5 * places * np.sin(np.radians(AZIMUTH_DEG))))
    files = []
    for device, part in enumerate(("master", "slave1", "slave2", "slave3")):
        own = np.moveaxis(cube[:, :, 4 * device : 4 * device + 4], 2, 3)
        content = np.rint(np.stack([own.real, own.imag], axis=-1)).astype("<i2").tobytes()
        (folder / f"{part}_0000_data.bin").write_bytes(2 * content)
        files.append(folder / f"{part}_0000_data.bin")
    return files


def write(folder: Path, content: bytes, config: str = CFG, suffix: str = "cfg") -> list[str]:
    """The words of a command on a capture of this content."""
    (folder / "capture.bin").write_bytes(content)
    (folder / f"chirps.{suffix}").write_text(config)
    files = [str(folder / "capture.bin"), "--config", str(folder / f"chirps.{suffix}"), "--out", str(folder / "out")]
    return ["import", "dca1000", *files]


def as_json_config(device: str | None = "xwr16xx") -> dict[str, Any]:
    """The chirps of `CFG` as an object, in part by the defaults."""
    named = {} if device is None else {"device": device}
    profile = [0, 77.0, 30, 6, 62, 0, 0, 60, 1, SAMPLES, 2500, 0, 0, 30]
    names = (
        "profile_id start_frequency_ghz idle_time_us adc_start_time_us ramp_end_time_us tx_backoff tx_phase_shifter "
        "slope_mhz_per_us tx_start_time_us adc_samples sample_rate_ksps hpf_corner_1 hpf_corner_2 rx_gain_db"
    )
    return {
        **named,
        "channelCfg": {"rx_mask": 15, "tx_mask": 3},
        "adcCfg": {"adc_bits": 2, "output_format": 1},
        "profileCfg": dict(zip(names.split(), profile, strict=True)),
        "chirpCfg": [{"start_index": at, "end_index": at, "profile_id": 0, "tx_mask": 1 << at} for at in (0, 1)],
        "frameCfg": {"chirp_start_index": 0, "chirp_end_index": 1, "loops": LOOPS, "frames": 2, "period_ms": 40},
    }


def assert_is_the_point(found: dict[str, float], speed_mps: float = SPEED_MPS) -> None:
    """Within half a range bin (4.9 cm), a step of azimuth (0.47 deg) and half a Doppler bin (0.16 m/s), rounded up.

    The carrier's own phase slope moves the beat of a mover by less than a hundredth of a bin.
    """
    assert found["range_m"] == pytest.approx(RANGE_M, abs=0.05)
    assert found["azimuth_deg"] == pytest.approx(AZIMUTH_DEG, abs=0.5)
    assert found["closing_speed_mps"] == pytest.approx(speed_mps, abs=0.17)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "config"),
    [
        (two_lanes(point()) * 2, CFG),
        (two_lanes(point(), q_first=True) * 2, CFG.replace("adcbufCfg -1 0 0 1 1", "adcbufCfg -1 0 1 1 1")),
        (four_lanes(point()) * 2, CFG_14),
        (real_lanes(point()) * 2, CFG_REAL),
        (
            real_four_lanes(point()) * 2,
            CFG_14.replace("adcCfg 2 1", "adcCfg 2 0").replace("Cfg 0 0 0 1", "Cfg 1 0 0 1"),
        ),
    ],
    ids=["two lanes", "two lanes, Q first", "four lanes", "real", "real, four lanes"],
)
def test_a_point_stands_where_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, config: str
) -> None:
    words = write(tmp_path, content, config)
    assert main([*words, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["frames"], said["loss"], said["channels"], said["left_out_transmitters"]) == (2, None, 8, [])
    for each in said["per_frame"]:
        assert_is_the_point(each["returns"][0])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary == {key: value for key, value in said.items() if key != "folder"}
    source = summary["provenance"]["capture"]
    assert source == {"name": "capture.bin", "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    assert summary["provenance"]["configuration"]["fields"]["profileCfg"]["adc_samples"] == SAMPLES
    assert (tmp_path / "out" / "ra_map.png").read_bytes().startswith(b"\x89PNG")


def test_a_channel_comes_back_as_it_went_in() -> None:
    """Both layouts carry the same codes to the same channel, exactly."""
    rng = np.random.default_rng(3)
    cube = rng.integers(-32768, 32768, (LOOPS, 2, 4, SAMPLES)) + 1j * rng.integers(
        -32768, 32768, (LOOPS, 2, 4, SAMPLES)
    )
    for content, text in ((two_lanes(cube), CFG), (four_lanes(cube), CFG_14)):
        config = parse_cfg(text, "chirps.cfg")
        samples = frame_samples(np.frombuffer(content, "<i2"), config)
        assert np.array_equal(samples, cube.reshape(LOOPS, 8, SAMPLES).astype(np.complex64))


@pytest.mark.slow
@pytest.mark.parametrize("masks", [(1, 4, 2), (2, 1, 4)])
def test_a_higher_transmitter_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], masks: tuple[int, ...]
) -> None:
    """Three take turns, in any order; the one that stands higher has foreign phases and must not be used."""
    config = CFG.replace("xWR16xx", "xWR18xx").replace("channelCfg 15 3 0", "channelCfg 15 7 0")
    config = config.replace("chirpCfg 0 0 0 0 0 0 0 1\nchirpCfg 1 1 0 0 0 0 0 2\n", "")
    config = config.replace("frameCfg 0 1", "frameCfg 0 2")
    config += "".join(f"chirpCfg {at} {at} 0 0 0 0 0 {mask}\n" for at, mask in enumerate(masks))
    cube = point(tuple({1: 0, 2: 2, 4: 4}[mask] for mask in masks))
    cube[:, masks.index(2)] *= -1.0
    assert main([*write(tmp_path, two_lanes(cube) * 2, config), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["channels"], said["left_out_transmitters"]) == (8, [2])
    assert said["speed_limit_mps"] == pytest.approx(SPEED_OF_LIGHT_MPS / CARRIER_HZ / (4 * 3 * CHIRP_S), rel=1e-6)
    assert_is_the_point(said["per_frame"][0]["returns"][0])


@pytest.mark.slow
def test_a_json_configuration_says_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And the device may come from the command line; receivers that run to the right turn the angle round."""
    config = json.dumps(as_json_config(None))
    words = write(tmp_path, two_lanes(point(speed_mps=-SPEED_MPS)) * 2, config, "json")
    assert main(words) == 2
    assert f"{tmp_path / 'chirps.json'}: device must be named" in capsys.readouterr().err
    assert main([*words, "--device", "xwr16xx", "--mirrored", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["per_frame"][1]["returns"][0]
    assert_is_the_point(found | {"azimuth_deg": -found["azimuth_deg"]}, -SPEED_MPS)


def test_maps_serve_the_detectors(tmp_path: Path) -> None:
    """What stands in the file makes a `RangeAzimuthMap` again, and CFAR finds the point on it."""
    assert main(write(tmp_path, two_lanes(point()) * 2)) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    with np.load(tmp_path / "out" / "maps-00000.npz", allow_pickle=False) as maps:
        grid = RangeAzimuthGrid(**summary["grid"])
        assert maps["values"].shape == (2, *grid.shape)
        assert maps["stamp_ns"].tolist() == [0, 40_000_000]
        assert np.array_equal(maps["range_m"], grid.range_m)
        noise_power_mw = float(maps["noise_power_mw"][0])
        ra_map = example_map(maps["values"][0], grid=grid, noise_power_mw=noise_power_mw)
    peaks = detect(ra_map, CfarParams())
    assert peaks.range_m[0] == pytest.approx(RANGE_M, abs=0.05)
    assert np.degrees(peaks.azimuth_rad[0]) == pytest.approx(AZIMUTH_DEG, abs=0.5)


def test_a_card_that_takes_two_of_four_lanes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Samples 0, 1, 4, 5, ... are stored; the point stands where it is, at 3.0 m of 3.1, and the loss is named."""
    stored = point()[..., np.arange(SAMPLES) % 4 < 2]
    config = as_json_config() | {"sent_lanes": 4}
    words = write(tmp_path, two_lanes(stored) * 2, json.dumps(config), "json")
    assert main([*words, "--json"]) == 3
    captured = capsys.readouterr()
    assert "two of four lanes were not taken, so that only the nearer half of the ranges is" in captured.err
    said = json.loads(captured.out)
    assert (said["frames"], said["grid"]["range_bins"]) == (2, SAMPLES // 2)
    assert_is_the_point(said["per_frame"][0]["returns"][0])


def test_samples_of_two_lanes_make_even_ones() -> None:
    """Tones on bins of the lower half come back exactly at samples 0, 2, 4, ...; noise has twice its power."""
    config = parse_json(json.dumps(as_json_config() | {"sent_lanes": 4}).encode(), "a.json")
    sample, bins = np.arange(SAMPLES), np.arange(8) * 4 + 3
    tones = 1000.0 * np.exp(2j * np.pi * np.multiply.outer(bins, sample) / SAMPLES)
    cube = np.broadcast_to(tones.reshape(1, 2, 4, SAMPLES), (LOOPS, 2, 4, SAMPLES))
    codes = np.frombuffer(two_lanes(cube[..., sample % 4 < 2]), "<i2")
    # codes are rounded: half a code each in I and Q, spread by the solution to no more than three times as much
    expected = np.broadcast_to(tones[:, ::2], (LOOPS, 8, SAMPLES // 2))
    np.testing.assert_allclose(frame_samples(codes, config), expected, atol=3.0)
    noise = np.random.default_rng(2).normal(0.0, 1000.0, (LOOPS, 2, 4, SAMPLES // 2, 2)) @ [1.0, 1.0j]
    samples = frame_samples(np.frombuffer(two_lanes(noise), "<i2"), config)
    assert np.mean(np.abs(samples) ** 2) / 2e6 == pytest.approx(2.0, rel=0.03)


FRAME = two_lanes(point())


@pytest.mark.slow
@pytest.mark.parametrize("cut", [1, len(FRAME) // 2, len(FRAME)])
def test_a_cut_last_frame_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str], cut: int) -> None:
    """Whole frames are kept, code 3, and the loss is named; down to within a sample."""
    assert main([*write(tmp_path, (FRAME * 2)[:-cut]), "--json"]) == 3
    captured = capsys.readouterr()
    said = json.loads(captured.out)
    assert (said["frames"], said["frames_wanted"], said["left_bytes"]) == (1, 2, len(FRAME) - cut)
    assert said["loss"].startswith("whole frames: 1 of 2")
    assert f"{tmp_path / 'capture.bin'}: {said['loss']}" in captured.err
    assert_is_the_point(said["per_frame"][0]["returns"][0])


@pytest.mark.slow
def test_a_capture_until_it_was_stopped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`frames` 0 takes as many as there are; 51 frames make a second file."""
    short = CFG.replace(f"frameCfg 0 1 {LOOPS} 2", "frameCfg 0 1 1 0")
    one = two_lanes(point(loops=1))
    assert main([*write(tmp_path, one * 51, short), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 51
    with np.load(tmp_path / "out" / "maps-00001.npz", allow_pickle=False) as maps:
        assert maps["scan_id"].tolist() == [50]
    (tmp_path / "cut").mkdir()
    assert main([*write(tmp_path / "cut", one * 2 + one[:7], short), "--json"]) == 3
    assert "7 bytes of one that is cut are left out" in capsys.readouterr().err


@pytest.mark.parametrize("names", [("a_Raw_0.bin", "a_Raw_1.bin", "a_Raw_2.bin"), ("x.bin", "b.bin", "c.bin")])
def test_a_capture_in_several_files(tmp_path: Path, capsys: pytest.CaptureFixture[str], names: tuple[str, ...]) -> None:
    """Cut within both frames: each frame holds its point. What follows is found by its name, or given in order."""
    words = write(tmp_path, FRAME * 2)
    cuts = 0, len(FRAME) // 2 + 2, len(FRAME) + 6, 2 * len(FRAME)
    for name, (start, end) in zip(names, itertools.pairwise(cuts), strict=True):
        (tmp_path / name).write_bytes((FRAME * 2)[start:end])
    # of a longer capture that was made here before
    (tmp_path / "a_Raw_3.bin").write_bytes(FRAME)
    given = names[:1] if "Raw_0" in names[0] else names
    words[2:3] = [str(tmp_path / name) for name in given]
    recording = tmp_path / "beams.mcap"
    assert main([*words, "--json", "--recording", str(recording)]) == 0
    captured = capsys.readouterr()
    said = json.loads(captured.out)
    assert said["frames"] == 2
    for frame in said["per_frame"]:
        assert_is_the_point(frame["returns"][0])
    assert [each["name"] for each in said["provenance"]["continued"]] == list(names[1:])
    assert captured.err.count("goes on in") == 3 - len(given)
    with RecordingReader(recording) as reader:
        assert sum(item.topic == "radar/beam" for item in reader.messages()) > 0


def test_a_file_that_goes_on_is_no_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = write(tmp_path, FRAME)
    (tmp_path / "capture.bin").rename(tmp_path / "a_Raw_1.bin")
    words[2] = str(tmp_path / "a_Raw_1.bin")
    assert main(words) == 2
    assert "a_Raw_1.bin: goes on anywhere in a frame of the capture that begins with a_Raw_0.bin" in (
        capsys.readouterr().err
    )
    (tmp_path / "a_Raw_1.bin").rename(tmp_path / "a_Raw_0.bin")
    (tmp_path / "a_Raw_2.bin").write_bytes(FRAME)
    words[2] = str(tmp_path / "a_Raw_0.bin")
    assert main(words) == 2
    assert "a_Raw_1.bin: is missing between files of one capture" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "rule"),
    [
        (b"", f"must hold a whole frame of {len(FRAME)} bytes, got 0"),
        (FRAME[:-1], f"must hold a whole frame of {len(FRAME)} bytes, got {len(FRAME) - 1}"),
        (FRAME * 2 + b"\0", f"size must be at most {2 * len(FRAME)} bytes (2 frames x {LOOPS} loops x 2 chirps"),
    ],
    ids=["empty", "no whole frame", "too long"],
)
def test_wrong_sizes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, rule: str) -> None:
    assert main(write(tmp_path, content)) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"mirrorwave: {tmp_path / 'capture.bin'}: {rule}")
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("config", "old", "new", "rule"),
    [
        (CFG, "sensorStop", "fancyCfg 1", "line 2: command must be one that is known, got 'fancyCfg'"),
        (CFG, "adcCfg 2 1", "adcCfg 2 x", "line 6: adcCfg must have numbers, got 'x'"),
        (CFG, "adcCfg 2 1", "adcCfg 2", "line 6: adcCfg must have 2 numbers (adc_bits, output_format), got 1"),
        (CFG, "adcCfg 2 1", "adcCfg 1 1", "adc_bits must be 2 (16 bits), got 1"),
        (CFG, "adcCfg 2 1", "adcCfg 2 0", "adcbufCfg.output_format must be 1 (real), got 0"),
        (CFG, "adcCfg 2 1", "adcCfg 2 1\nadcCfg 2 1", "line 7: adcCfg must stand once"),
        (CFG, "adcCfg 2 1", "", "missing required field `adcCfg`"),
        (CFG, "dfeDataOutputMode 1", "dfeDataOutputMode 3", "line 4: dfeDataOutputMode must be 1"),
        (CFG, "sensorStop", "bpmCfg -1 1 0 1", "line 2: bpmCfg must be 0 (transmitters take turns)"),
        (CFG, "xWR16xx", "xWR68xx", "`$.device`, got 'xwr68xx'"),
        (CFG, "% Platform:xWR16xx", "%", "device must be named, one of xwr14xx, xwr16xx, xwr18xx"),
        (CFG, "adcbufCfg -1 0 0 1 1", "adcbufCfg -1 0 0 0 1", "channel_interleave must be 1 on xwr16xx, got 0"),
        (CFG, "adcbufCfg -1 0 0 1 1", "adcbufCfg -1 1 0 1 1", "output_format must be 0 (complex), got 1"),
        (CFG, "lvdsStreamCfg -1 0 1 0", "lvdsStreamCfg -1 1 1 0", "header must be 0 (no headers), got 1"),
        (CFG, "channelCfg 15 3 0", "channelCfg 0 3 0", "rx_mask must be 1..65535, got 0"),
        (CFG, "channelCfg 15 3 0", "channelCfg 15 1 0", "chirpCfg.tx_mask must be a transmitter of xwr16xx"),
        (CFG, "0 0 0 0 0 2\n", "0 0 0 0 0 3\n", "tx_mask must name one transmitter (1, 2, 4, ...), got 3"),
        (CFG, "chirpCfg 1 1 0", "chirpCfg 1 1 4", "chirpCfg.profile_id must be that of profileCfg, 0, got 4"),
        (CFG, "chirpCfg 1 1 0", "chirpCfg 0 1 0", "chirpCfg must name chirp 0 of frameCfg once, got 2 times"),
        (CFG, "chirpCfg 1 1 0 0", "chirpCfg 1 1 0 9", "start_frequency_deviation must be 0 (all chirps alike), got 9"),
        (CFG, "0 77.0 30", "0 nan 30", "start_frequency_ghz must be 57..81, got nan"),
        (CFG, "0 77.0 30 6 62", "0 77.0 30 6 30", "ramp_end_time_us must not be before the last sample, 31.6, got 30"),
        (CFG, f"1 {SAMPLES} 2500", "1 63 2500", "profileCfg.adc_samples must be even with two lanes (xwr16xx), got 63"),
        (CFG, f"1 {SAMPLES} 2500", "1 64.5 2500", "`$.profileCfg.adc_samples`, got 64.5"),
        (CFG, f"{LOOPS} 2 40", f"{LOOPS} 2 4", "frameCfg.period_ms must hold all chirps, 5.888, got 4"),
        (CFG, f"{LOOPS} 2 40", "0 2 40", "loops must be 1..65535, got 0"),
        (CFG_14, "channelCfg 15 5 0", "channelCfg 7 5 0", "rx_mask must be 15 with four lanes (xwr14xx), got 7"),
        (CFG_2944, "adcCfg 2 0", "adcCfg 2 1", "adcCfg.output_format must be 0 (real, as awr2944 samples), got 1"),
        (CFG_2944, "adcbufCfg -1 1 1 1 1", "adcbufCfg -1 0 1 1 1", "adcbufCfg.output_format must be 1 (real), got 0"),
        (CFG_2944, "1 10 1 11 0.5 0.8", "1 10 1 12 0.5 0.8", "antGeometryCfg must be that of AWR2944EVM, got 1 0 1 1"),
        (CFG_2944, "chirpCfg 2 2 0 0 0 0 0 4", "chirpCfg 2 2 0 0 0 0 0 16", "tx_mask must be a transmitter of awr2944"),
        (CFG_2944, "0 77.0 30", "0 60.0 30", "profileCfg.start_frequency_ghz must be 76..81, got 60.0"),
        (CFG_6844, "channelCfg 153 255 0", "channelCfg 153 15 0", "tx_mask must be 255 (all in turn, evenly), got 15"),
        (CFG_6844, f"{SAMPLES} 1 62 0", f"{SAMPLES} 4 62 0", "pattern must be 1 (all in turn, evenly), got 4"),
        (CFG_6844, "chirpTimingCfg 30 20 1 60 60\n", "", "chirpTimingCfg must be given"),
        (CFG_6844, "chirpTimingCfg 30 20 1 60 60", "chirpTimingCfg 30 20 1 60", "must have 5 numbers (idle_us, "),
        (CFG_6844, "1 60 60", "1 nan 60", "slope_mhz_per_us must be finite"),
        (CFG_6844, "0 11776 1 40 2", "0 11776 2 40 2", "frameCfg.bursts must be 1 (all in turn, evenly), got 2"),
        (CFG_6844, "xWRL6844EVM", "xWRL6432EVM", "device"),
    ],
)
def test_wrong_configurations_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], config: str, old: str, new: str, rule: str
) -> None:
    assert old in config
    assert main(write(tmp_path, FRAME * 2, config.replace(old, new, 1))) == 2
    said = capsys.readouterr().err
    assert rule in said
    assert said.startswith(f"mirrorwave: {tmp_path / 'chirps.cfg'}: ")
    assert said.count("\n") == 1


@pytest.mark.slow
def test_two_lanes_take_fewer_receivers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Receivers 2 and 4 alone: a wavelength apart, so that 20 deg has an alias at -41 deg; its range stands."""
    config = CFG.replace("channelCfg 15 3 0", "channelCfg 10 3 0")
    assert main([*write(tmp_path, two_lanes(point()[:, :, 1::2]) * 2, config), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["channels"] == 4
    found = said["per_frame"][0]["returns"][:2]
    assert {round(one["range_m"], 1) for one in found} == {3.0}
    assert min(abs(one["azimuth_deg"] - AZIMUTH_DEG) for one in found) <= 1.0


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"cfarCfg": {}}, "unknown field `cfarCfg`"),
        ({"adcCfg": {"adc_bits": "16", "output_format": 1}}, "`$.adcCfg.adc_bits`, got '16'"),
        (
            {"channelCfg": {"rx_mask": 15, "tx_mask": 3, "gain": 1}},
            "`gain`; known are rx_mask, tx_mask, cascading - at `$.chan",
        ),
        ({"chirpCfg": []}, "chirpCfg must name chirp 0 of frameCfg once, got 0 times"),
        ({"frameCfg": 3}, "`$.frameCfg`, got 3"),
        ({"device": 16}, "`$.device`, got 16"),
    ],
)
def test_wrong_json_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], rule: str
) -> None:
    config = json.dumps(as_json_config() | change)
    assert main(write(tmp_path, FRAME * 2, config, "json")) == 2
    said = capsys.readouterr().err
    assert rule in said
    assert said.count("\n") == 1


@pytest.mark.slow
def test_files_and_options_are_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = write(tmp_path, FRAME * 2)
    assert main([*words, "--device", "xwr18xx"]) == 2
    assert "device must be xwr18xx as asked for, got 'xwr16xx'" in capsys.readouterr().err
    assert main([*words, "--min-range-m", "nan"]) == 2
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("kept")
    assert main(words) == 2
    assert f"{tmp_path / 'out'}: must be a new or an empty folder" in capsys.readouterr().err
    (tmp_path / "chirps.cfg").write_bytes(b"\xff\xfea")
    assert main(words) == 2
    assert "must be UTF-16 text, got byte 0x61 at 2" in capsys.readouterr().err
    (tmp_path / "capture.bin").unlink()
    (tmp_path / "chirps.cfg").write_text(CFG)
    assert main(words) == 2


def test_a_single_loop_has_nothing_that_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = CFG.replace(f"frameCfg 0 1 {LOOPS} 2", "frameCfg 0 1 1 2")
    assert main([*write(tmp_path, two_lanes(point(loops=1)) * 2, config), "--remove-static"]) == 2
    assert "frameCfg.loops must be at least 2 to remove what stands still, got 1" in capsys.readouterr().err


@pytest.mark.slow
def test_silence_has_no_returns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A frame of zeros, as the board writes for packets that it lost, is a map like any other."""
    assert main([*write(tmp_path, bytes(len(FRAME)) + FRAME), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["per_frame"][0]["returns"] == []
    assert_is_the_point(said["per_frame"][1]["returns"][0])


@pytest.mark.slow
def test_noise_alone_has_no_returns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One value reaches 15 dB over the mean with exp(-31.6); a map is chosen from half a million."""
    rng = np.random.default_rng(11)
    noise = 100.0 * (rng.normal(size=(2, LOOPS, 2, 4, SAMPLES)) + 1j * rng.normal(size=(2, LOOPS, 2, 4, SAMPLES)))
    assert main([*write(tmp_path, b"".join(two_lanes(one) for one in noise)), "--json"]) == 0
    assert [each["returns"] for each in json.loads(capsys.readouterr().out)["per_frame"]] == [[], []]


@pytest.mark.slow
def test_full_scale_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Every fourth code at the end of the scale."""
    codes = np.tile(np.array([32767, 0, 0, 0], "<i2"), len(FRAME) // 8)
    assert main([*write(tmp_path, codes.tobytes() + FRAME), "--json"]) == 0
    frames = json.loads(capsys.readouterr().out)["per_frame"]
    assert [each["saturated_share"] for each in frames] == [0.25, 0.0]


def real_cfg() -> str:
    """Chirps as the capture's notes give them; its period is not documented and stands for any."""
    text = CFG.replace(f"0 77.0 30 6 62 0 0 60 1 {SAMPLES}", "0 77.4201 30 0 62 0 0 60 1 128")
    return text.replace(f"frameCfg 0 1 {LOOPS} 2", "frameCfg 0 1 128 1")


@pytest.mark.slow
@needs(AWR)
def test_real_77_ghz_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The published samples in the board's own layout: 2.93 m, 0.56 m/s, 6.8 deg (docs/results/README.md)."""
    raw = np.load(AWR)
    real, imag = (part.astype(np.uint16).view(np.int16).astype(float) for part in (raw.real, raw.imag))
    cube = (real + 1j * imag).reshape(128, 2, 4, 128)
    words = write(tmp_path, two_lanes(cube), real_cfg())
    assert main([*words, "--remove-static", "--min-range-m", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["per_frame"][0]["returns"][0]
    assert found["range_m"] == pytest.approx(2.93, abs=0.03)
    assert abs(found["closing_speed_mps"]) == pytest.approx(0.56, abs=0.02)
    assert abs(found["azimuth_deg"]) == pytest.approx(6.8, abs=0.3)


def test_a_recording_gives_hidden_objects_its_beams(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beams at the times of the frames, 40 ms apart; the map of a scan shows the point; nothing is overwritten."""
    out = tmp_path / "beams.mcap"
    words = [*write(tmp_path, two_lanes(point()) * 2), "--recording", str(out)]
    assert main(words) == 0
    with RecordingReader(out) as reader:
        messages = list(reader.messages(("radar/setup", "radar/beam")))
    setup, *beams = [each.message for each in messages]
    assert isinstance(setup, RadarSetup)
    assert [beam.stamp_ns for beam in beams] == [0] * 8 + [40_000_000] * 8
    assert messages[1].log_time_ns == round(1e9 * LOOPS * 2 * CHIRP_S)
    former = RaFormer(setup)
    (ra_map,) = [ra_map for beam in beams[:8] for ra_map in former.add(beam)]
    row, column = np.unravel_index(np.abs(ra_map.values).argmax(), ra_map.grid.shape)
    assert ra_map.grid.range_m[row] == pytest.approx(RANGE_M, abs=0.05)
    assert np.degrees(ra_map.grid.azimuth_rad[column]) == pytest.approx(AZIMUTH_DEG, abs=0.5)
    capsys.readouterr()
    assert main(words) == 2
    assert "beams.mcap" in capsys.readouterr().err


@pytest.mark.slow
@needs(TASK3)
def test_a_real_capture_by_its_script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Three transmitters in the order 2, 1, 3 and two of four lanes; the first 20 of its 1000 frames."""
    capture = tmp_path / "cut.bin"
    capture.write_bytes((TASK3 / "task3_gt_Raw_0.bin").read_bytes()[: 20 * 3072 + 5])
    words = [str(capture), "--config", str(TASK3 / "1843_config_debug_task3.lua"), "--out", str(tmp_path / "out")]
    assert main(["import", "dca1000", *words, "--json"]) == 3
    said = json.loads(capsys.readouterr().out)
    assert (said["frames"], said["frames_wanted"], said["left_bytes"], said["channels"]) == (20, 1000, 5, 8)
    assert said["left_out_transmitters"] == [2]
    assert said["loss"].startswith(
        "whole frames: 20 of 1000, 5 bytes of one that is cut are left out; two of four lanes"
    )
    assert said["grid"]["range_bins"] * said["grid"]["range_bin_m"] == pytest.approx(2.90, abs=0.01)


def test_real_samples_become_half_as_many_complex_ones() -> None:
    """Of tones anywhere between the bins: amplitude within 2 %, and 55 dB under it ten bins away, by Hann's window."""
    config = parse_cfg(CFG_REAL, "a.cfg")
    for bins in (7.0, 11.3, 20.5):
        tone = 1000.0 * np.cos(2.0 * np.pi * bins * np.arange(SAMPLES) / SAMPLES + 0.4)
        codes = np.broadcast_to(np.rint(tone).astype("<i2"), config.frame_shape)
        samples = frame_samples(codes.ravel(), config)
        assert samples.shape == (LOOPS, 8, SAMPLES // 2)
        window = np.hanning(SAMPLES // 2 + 1)[:-1]
        spectrum = np.abs(np.fft.fft(samples[0, 0] * window, 512)) / window.sum()
        at = int(spectrum.argmax())
        assert at / 16.0 == pytest.approx(bins, abs=0.1)
        assert spectrum[at] == pytest.approx(1000.0, rel=0.02)
        assert spectrum[max(0, at - 288) : max(0, at - 160)].max(initial=0.0) < 1.8
        assert spectrum[at + 160 : at + 288].max(initial=0.0) < 1.8


@pytest.mark.slow
def test_an_awr2944_has_twelve_channels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cube = point((0, 50, 4, 8))
    assert main([*write(tmp_path, real_lanes(cube) * 2, CFG_2944), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["device"], said["channels"], said["left_out_transmitters"]) == ("awr2944", 12, [2])
    assert_is_the_point(said["per_frame"][1]["returns"][0])


@pytest.mark.slow
def test_an_awrl6844_by_the_commands_of_its_sdk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*write(tmp_path, l_sdk_capture() * 2, CFG_6844), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["device"], said["channels"], said["left_out_transmitters"]) == ("awrl6844", 4, [3, 4])
    assert said["carrier_hz"] == pytest.approx(CARRIER_6844_HZ)
    assert_is_the_point(said["per_frame"][1]["returns"][0])


@pytest.mark.slow
def test_a_cascade_has_eighty_six_channels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the master's name alone; the recording gives the row's beams."""
    files = cascade_files(tmp_path)
    (tmp_path / "chirps.json").write_text(cascade_json())
    words = ["import", "dca1000", str(files[0]), "--config", str(tmp_path / "chirps.json"), "--json", "--out"]
    assert main([*words, str(tmp_path / "out"), "--recording", str(tmp_path / "a.mcap")]) == 0
    captured = capsys.readouterr()
    said = json.loads(captured.out)
    assert "slave3_0000_data.bin" in captured.err
    assert (said["frames"], said["channels"], said["left_out_transmitters"]) == (2, 86, [1, 2, 3])
    found = said["per_frame"][1]["returns"][0]
    assert found["range_m"] == pytest.approx(RANGE_M, abs=0.05)
    assert found["azimuth_deg"] == pytest.approx(AZIMUTH_DEG, abs=0.5)
    with RecordingReader(tmp_path / "a.mcap") as reader:
        beams = [item.message for item in reader.messages(("radar/beam",))]
    assert len(beams) == 2 * 86


def test_cascades_that_do_not_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = cascade_files(tmp_path)
    config = tmp_path / "chirps.json"
    words = ["import", "dca1000", str(files[0]), "--config", str(config), "--out", str(tmp_path / "out")]
    narrow = {"channelCfg": {"rx_mask": 15, "tx_mask": 0xFFF}}
    for text, rule in (
        (cascade_json(**narrow), "channelCfg.rx_mask must be 65535 with four lanes (awr2243_cascade), got 15"),
        (cascade_json(adcCfg={"adc_bits": 2, "output_format": 0}), "adcCfg.output_format must be 1 or 2 on awr2243"),
    ):
        config.write_text(text)
        assert main(words) == 2
        said = capsys.readouterr().err
        assert f"chirps.json: {rule}" in said
        assert len(said.splitlines()) == 1
    config.write_text(cascade_json())
    assert main([*words[:2], str(files[1]), *words[3:]]) == 2
    assert "slave1_0000_data.bin: must be the file of the master, or all 4, got 1" in capsys.readouterr().err
    files[3].write_bytes(files[3].read_bytes()[:1000])
    assert main(words) == 2
    assert "master_0000_data.bin: must hold a whole frame of 393216 bytes, got 4000" in capsys.readouterr().err
    files[3].unlink()
    assert main(words) == 2
    assert "slave3_0000_data.bin: No such file" in capsys.readouterr().err


def test_real_samples_that_do_not_fit_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A capture of complex samples is twice as long as one of real ones."""
    assert main(write(tmp_path, two_lanes(point()) * 2, CFG_REAL)) == 2
    assert "x 64 samples x 2), got" in capsys.readouterr().err
    assert main(write(tmp_path, real_lanes(point())[:-1], CFG_REAL)) == 2
    assert "must hold a whole frame of 32768 bytes, got 32767" in capsys.readouterr().err
