"""`mirrorwave import board`: an analytic point in the published layouts comes back in its place; files that do not fit.

Neither board was at hand: the layouts are those that published readers take.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mirrorwave.cli import main
from models.perception.form.ra_former import RaFormer
from msgs.recording.mcap import RecordingReader
from msgs.values.units import SPEED_OF_LIGHT_MPS

RANGE_M, AZIMUTH_RAD = 5.0, np.radians(20.0)
BANDWIDTH_HZ, SAMPLES = 1e9, 128
#: c / 2B.
BIN_M = 0.15
#: The two elements' beam is 60 deg wide, but a single point's phase between them is measured to the codes' rounding;
#: the map steps by 0.5 deg.
TOLERANCE_DEG = 1.0
CONFIG: dict[str, Any] = {
    "rx_antennas": [1, 2, 3], "tx_antennas": [1], "start_frequency_Hz": 60e9, "end_frequency_Hz": 60e9 + BANDWIDTH_HZ,
    "num_samples_per_chirp": SAMPLES, "num_chirps_per_frame": 8, "sample_rate_Hz": 2_000_000,
    "chirp_repetition_time_s": 2e-4, "frame_repetition_time_s": 0.1,
}  # fmt: skip
#: Receiver 1 is on the left.
RECEIVERS_Y_M = (1.25e-3, -1.25e-3, -1.25e-3)


def beat_rad(start_hz: float, y_m: float) -> np.ndarray:
    """Phase of the mixed echo at the samples of a sweep, from its delay alone."""
    delay_s = (2.0 * RANGE_M - y_m * np.sin(AZIMUTH_RAD)) / SPEED_OF_LIGHT_MPS
    swept_hz = BANDWIDTH_HZ * np.arange(SAMPLES) / SAMPLES
    return np.asarray(2.0 * np.pi * (start_hz + swept_hz) * delay_s)


def infineon(folder: Path, array: np.ndarray | None = None, **changed: Any) -> Path:
    folder.mkdir()
    config = {name: value for name, value in {**CONFIG, **changed}.items() if value is not None}
    (folder / "config.json").write_text(json.dumps({"device_config": {"fmcw_single_shape": config}}))
    np.save(folder / "radar.npy", shares() if array is None else array)
    return folder


def shares(frames: int = 2) -> np.ndarray:
    """Real samples [frames, receivers, chirps, samples], of the ADC's full scale; receiver 2 sees another phase."""
    each = [np.cos(beat_rad(60e9, y_m) + turn) for y_m, turn in zip(RECEIVERS_Y_M, (0.0, 1.0, 0.0), strict=True)]
    return np.asarray(0.5 + 0.4 * np.tile(np.array(each)[None, :, None], (frames, 1, 8, 1)))


def ancortek(path: Path, sweeps: int = 64, channels: int = 2) -> Path:
    quarter_m = SPEED_OF_LIGHT_MPS / 25e9 / 4.0
    each = [np.exp(1j * beat_rad(24.5e9, y_m)) for y_m in (-quarter_m, quarter_m)[:channels]]
    values = 2000 + 2000j + 900.0 * np.tile(np.array(each).T.ravel(), sweeps)
    lines = [f"{value.real:.0f}{value.imag:+.0f}i" for value in values]
    path.write_text("\n".join(["25000000000", "1", f"{SAMPLES}", f"{BANDWIDTH_HZ:.0f}", *lines, ""]))
    return path


def brought(source: Path, out: Path, code: int = 0) -> list[Any]:
    """Messages of the recording, set-up first."""
    assert main(["import", "board", str(source), "--out", str(out)]) == code
    with RecordingReader(out) as reader:
        return [item.message for item in reader.messages(("radar/setup", "radar/beam"))]


def assert_shows_the_point(messages: list[Any]) -> None:
    setup, *beams = messages
    former = RaFormer(setup)
    (ra_map,) = [ra_map for beam in beams[-2:] for ra_map in former.add(beam)]
    row, column = np.unravel_index(np.abs(ra_map.values).argmax(), ra_map.grid.shape)
    assert ra_map.grid.range_m[row] == pytest.approx(RANGE_M, abs=BIN_M)
    assert np.degrees(ra_map.grid.azimuth_rad[column]) == pytest.approx(20.0, abs=TOLERANCE_DEG)


def test_infineon_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As shares of the full scale, as codes of 12 bits, under older names without the outer keys, within a parent."""
    messages = brought(infineon(tmp_path / "RadarIfxAvian_00"), tmp_path / "a.mcap")
    assert [beam.stamp_ns for beam in messages[1:]] == [0, 0, 100_000_000, 100_000_000]
    assert_shows_the_point(messages)
    assert "assumed: receiver 1 is to the left of 3 as the radar looks" in capsys.readouterr().err
    folder = infineon(tmp_path / "parent", np.rint(4095 * shares()).astype("<u2"))
    config = {key.replace("start", "lower").replace("end_", "upper_"): value for key, value in CONFIG.items()}
    (folder / "config.json").write_text(json.dumps(config))
    assert_shows_the_point(brought(folder, tmp_path / "b.mcap"))
    np.testing.assert_array_equal(brought(tmp_path, tmp_path / "c.mcap")[3].samples, messages[3].samples)


def test_infineon_cut(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = infineon(tmp_path / "a", shares(3)) / "radar.npy"
    path.write_bytes(path.read_bytes()[:-7])
    assert len(brought(tmp_path / "a", tmp_path / "a.mcap", code=3)) == 1 + 2 * 2
    assert "whole frames: 2 of 3, 24569 bytes of one that is cut are left out" in capsys.readouterr().err


def test_ancortek_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """32 sweeps of 1 ms a scan; what follows the last whole scan is counted."""
    messages = brought(ancortek(tmp_path / "a.dat"), tmp_path / "a.mcap")
    assert [beam.stamp_ns for beam in messages[1:]] == [0, 0, 32_000_000, 32_000_000]
    assert_shows_the_point(messages)
    assert "assumed: two receivers" in capsys.readouterr().err
    assert len(brought(ancortek(tmp_path / "b.dat", sweeps=37), tmp_path / "b.mcap", code=3)) == 1 + 2
    assert "5 sweeps after the last whole scan of 32 left out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "array", "rule"),
    [
        ({"sample_rate_Hz": None}, None, "config.json: Object missing required field `sample_rate_Hz`"),
        ({"sample_rate_Hz": -1}, None, "config.json: Expected `float` > 0.0 - at `$.sample_rate_Hz`, got -1"),
        ({"sample_rate_Hz": 10**400}, None, "config.json: Number out of range"),
        ({"rx_antennas": [1, 2]}, None, "config.json: rx_antennas must name 1 and 3"),
        ({"end_frequency_Hz": 60e9}, None, "config.json: end_frequency_Hz must be above start_frequency_Hz"),
        ({"chirp_repetition_time_s": 0.1}, None, "frame_repetition_time_s must hold all chirps, 0.8, got 0.1"),
        ({"chirp_repetition_time_s": 1e-6}, None, "config.json: radar.chirp_interval_s must be finite and no shorter"),
        ({}, np.zeros((2, 3, 8, 64)), "radar.npy: must hold real numbers [frames, 3, 8, 128], as config"),
        ({}, np.zeros((0, 3, 8, 128)), "radar.npy: must hold a whole frame of 24576 bytes, got 0"),
        ({}, np.full((1, 3, 8, 128), np.nan), "radar.npy: frame 0: samples must be 0..4096, got nan"),
        ({}, np.array([{}]), "radar.npy: must be a NumPy array: must hold numbers in C order, got object"),
    ],
)
def test_infineon_folders_that_do_not_fit(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changed: dict[str, Any], array: np.ndarray | None, rule: str
) -> None:
    assert_refused(infineon(tmp_path / "a", array, **changed), rule, capsys)


def test_ancortek_files_that_do_not_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = ancortek(tmp_path / "a.dat")
    text = path.read_text()
    for changed, rule in (
        ("", "a.dat: line 1: carrier [Hz] must be a finite number such as 1 or 1+2i, got ''"),
        (text.replace("\n1\n", "\n0\n", 1), "a.dat: line 2: sweep time [ms] must be real and positive, got 0+0j"),
        (text + "1+nani\n", f"a.dat: line {5 + 64 * 256}: a value must be a finite number"),
        (text + "1+1i\n", "a.dat: must hold whole sweeps of 128 values, got 16385 values"),
        (ancortek(path, 3, 1).read_text(), "a.dat: must hold two channels, as one has no directions: 3 sweeps"),
        (ancortek(path, 64, 1).read_text(), "as one has no directions: values change after one sweep of 128"),
    ):
        path.write_text(changed)
        assert_refused(path, rule, capsys)
    assert_refused(tmp_path, "must be or hold one folder RadarIfxAvian_NN with radar.npy, got 0", capsys)


def assert_refused(source: Path, rule: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = source.with_name("refused.mcap")
    assert main(["import", "board", str(source), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert rule in said
    assert said.count("\n") == 1
    assert not out.exists()
