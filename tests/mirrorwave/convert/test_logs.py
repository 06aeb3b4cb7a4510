"""`mirrorwave import can` and `import sigmf`: every format, provenance, and what does not fit."""

from __future__ import annotations

import gzip
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from mirrorwave.cli import main
from msgs.recording.mcap import RecordingReader, info
from msgs.recording.sigmf import write_capture
from msgs.values.radar import BeamGrid, RadarBeam, RadarParams, RadarSetup
from msgs.values.vehicle import VehicleState
from tests.builders import beam_of
from tests.mirrorwave.commands.captures.test_can import DBC, MAPPING, write_drive

#: The drive of `write_drive`: seconds, its frames at 50 Hz, and states that are valid.
SECONDS = 3


def run(capsys: pytest.CaptureFixture, *arguments: object) -> tuple[int, dict]:
    code = main(["import", *map(str, arguments), "--json"])
    out = capsys.readouterr().out
    return code, json.loads(out) if out else {}


def states_of(path: Path) -> list[VehicleState]:
    with RecordingReader(path) as reader:
        return [each.message for each in reader.messages() if isinstance(each.message, VehicleState)]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("can") / "drive.log", SECONDS)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc", ".csv", ".log.gz", ".asc.gz"])
def test_every_format_gives_the_same_states(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Written by python-can itself; TRC and ASC keep milliseconds or microseconds, so stamps agree to 1 ms."""
    log, out = write_drive(tmp_path / f"drive{suffix}", SECONDS), tmp_path / "drive.mcap"
    code, found = run(capsys, "can", log, "--out", out)
    assert code == 0
    assert (found["frames"], found["loss"]) == (300, None)
    assert found["frames_by_verdict"]["wrong checksum"] == 20
    states = states_of(out)
    assert len(states) == found["states"]
    assert {state.speed_mps for state in states if state.valid} == {9.0}
    assert sum(state.valid for state in states) == found["valid_states"] > 100
    span_s = 1e-9 * (states[-1].stamp_ns - states[0].stamp_ns)
    assert span_s == pytest.approx(SECONDS - 0.02, abs=2e-3)
    assert info(out).loss is None


@pytest.mark.parametrize("at", [1, 150, 299])
@pytest.mark.parametrize("step_s", [-1e9, 3600.0], ids=["-32 years", "an hour"])
def test_a_clock_that_was_set_costs_no_time(
    step_s: float, at: int, tmp_path: Path, caplog: pytest.LogCaptureFixture, drive: Path
) -> None:
    """The states have the stamps that they would have with a clock that was right, as in the live node's replay."""
    lines = drive.read_text().splitlines()
    stepped = tmp_path / "stepped.log"
    stepped.write_text("\n".join([*lines[:at], *(later(line, step_s) for line in lines[at:])]) + "\n")
    off = tmp_path / "off.log"
    off.write_text("\n".join([*lines[:at], later(lines[at], step_s), *lines[at + 1 :]]) + "\n")
    stamps_ns = []
    for log in (drive, stepped, off):
        out = tmp_path / f"{log.stem}.mcap"
        assert main(["import", "can", str(log), "--out", str(out), "--start-ns", "0"]) == 0
        stamps_ns.append(np.array([state.stamp_ns for state in states_of(out)]))
    assert caplog.text.count("the log's clock was") >= 2
    for stamps in stamps_ns[1:]:
        # two messages, 10 ms apart: what is a usual interval is known to one of them
        assert abs(stamps - stamps_ns[0]).max() <= 20_000_000


def later(line: str, by_s: float) -> str:
    stamp, rest = line.split(") ", 1)
    return f"({float(stamp[1:]) + by_s:.6f}) {rest}"


def test_provenance_and_time_base(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = tmp_path / "drive.mcap"
    assert run(capsys, "can", drive, "--out", out, "--start-ns", 5_000_000_000)[0] == 0
    found = info(out)
    for name, path in (("source", drive), ("dbc", DBC), ("mapping", MAPPING)):
        assert found.metadata[name] == path.name
        assert found.metadata[f"{name}_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert found.metadata["time_base"] == "first frame at 5000000000 ns"
    assert found.start_ns == 5_000_000_000
    assert main(["import", "can", str(drive), "--out", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_log_that_breaks_off_is_kept_and_told(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A candump with a broken line; a BLF cut in its last object; a gzip cut in the middle."""
    broken = tmp_path / "broken.log"
    broken.write_text(drive.read_text() + "(1700000009.0) can0 nonsense\n")
    code, found = run(capsys, "can", broken, "--out", tmp_path / "a.mcap")
    assert (code, found["frames"]) == (3, 300)
    assert "cannot be read after 300 frames" in found["loss"]
    assert info(tmp_path / "a.mcap").loss is None
    packed = tmp_path / "cut.log.gz"
    whole = gzip.compress(drive.read_bytes(), mtime=0)
    packed.write_bytes(whole[: len(whole) // 2])
    code, found = run(capsys, "can", packed, "--out", tmp_path / "b.mcap")
    assert (code, 0 < found["frames"] < 300) == (3, True)


def test_a_cut_blf_is_one_line_or_whole(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Cut anywhere: either what is before the cut (codes 0, 3), or one line that names the file (code 2)."""
    data = write_drive(tmp_path / "drive.blf", SECONDS).read_bytes()
    for number, share in enumerate((0.0, 0.01, 0.3, 0.7, 0.99)):
        cut = tmp_path / f"cut{number}.blf"
        cut.write_bytes(data[: int(share * len(data))])
        code = main(["import", "can", str(cut), "--out", str(tmp_path / f"{number}.mcap")])
        captured = capsys.readouterr()
        assert code in (0, 2, 3)
        assert (tmp_path / f"{number}.mcap").exists() == (code != 2)
        if code == 2:
            assert captured.err.count("\n") == 1
            assert cut.name in captured.err


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--dbc", "launch/can/mirrorwave_out.dbc"], "the DBC has no message 'MW_SPEED'"),
        (["--mapping", "launch/can/mirrorwave.dbc"], "mirrorwave.dbc"),
        (["--channel", "can9"], "holds no frames of channel can9"),
        (["--start-ns", "-1"], "--start-ns must not be negative"),
    ],
)
def test_what_does_not_fit_is_refused(
    arguments: list[str], reason: str, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["import", "can", str(drive), "--out", str(tmp_path / "a.mcap"), *arguments]) == 2
    error = capsys.readouterr().err
    assert reason in error
    assert error.count("\n") == 1
    assert not (tmp_path / "a.mcap").exists()


def test_a_log_of_another_car_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    other = tmp_path / "other.log"
    other.write_text("".join(f"({1700000000 + 0.01 * step:.6f}) can0 2B0#0011\n" for step in range(200)))
    assert main(["import", "can", str(other), "--out", str(tmp_path / "a.mcap")]) == 2
    error = capsys.readouterr().err
    assert "gives no valid state" in error
    assert "wrong DBC?" in error
    assert not (tmp_path / "a.mcap").exists()


def capture(folder: Path) -> tuple[Path, list[RadarBeam]]:
    """A small capture of two scans of two beams."""
    radar = RadarParams(chirps_per_beam=1, samples_per_chirp=64)
    setup = RadarSetup(radar=radar, beams=BeamGrid(azimuth_deg=(-5.0, 5.0)))
    rng = np.random.default_rng(0)
    beams = [
        beam_of(
            setup,
            index,
            rng.integers(-99, 99, (1, 64, 2), dtype=np.int16),
            stamp_ns=1_000_000 * (10 * scan + index),
            scan_id=scan,
        )
        for scan in range(2)
        for index in range(2)
    ]
    return write_capture(folder / "capture", setup, beams)[0], beams


def test_sigmf_becomes_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    meta, beams = capture(tmp_path)
    out = tmp_path / "capture.mcap"
    code, found = run(capsys, "sigmf", meta, "--out", out)
    assert (code, found["beams"], found["truth"]) == (0, 4, 0)
    with RecordingReader(out) as reader:
        messages = list(reader.messages())
        metadata = reader.metadata
    assert [each.topic for each in messages] == ["radar/setup"] + ["radar/beam"] * 4
    for each, beam in zip(messages[1:], beams, strict=True):
        assert isinstance(each.message, RadarBeam)
        assert np.array_equal(each.message.samples, beam.samples)
        assert each.message.stamp_ns == beam.stamp_ns
    assert metadata["source"] == meta.name
    assert metadata["source_sha256"] == hashlib.sha256(meta.read_bytes()).hexdigest()
    assert json.loads(metadata["sigmf_global"])["core:datatype"] == "ci16_le"


def test_sigmf_whose_clock_was_set_back_keeps_its_order(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """As the player gives it: a recording is read in the order of its times."""
    meta, _ = capture(tmp_path)
    content, out = json.loads(meta.read_text()), tmp_path / "a.mcap"
    for number, each in enumerate(content["captures"]):
        each["mirrorwave:stamp_ns"] = 10**18 + 10**6 * number - (5 * 10**9 if number >= 2 else 0)
    meta.write_text(json.dumps(content))
    assert main(["import", "sigmf", str(meta), "--out", str(out)]) == 0
    assert f"{meta}: the clock was set by -5.0 s after 2 beams" in caplog.text
    with RecordingReader(out) as reader:
        order = [(each.message.scan_id, each.message.beam_index) for each in reader.messages(["radar/beam"])]  # type: ignore[attr-defined]
    assert order == [(0, 0), (0, 1), (1, 0), (1, 1)]


@pytest.mark.parametrize(
    ("key", "value", "rule"),
    [
        ("core:datatype", "cf32_le", "must be ci16_le"),
        ("core:sample_rate", None, "core:sample_rate"),
        ("mirrorwave:beams_per_scan", 2.5, "mirrorwave:beams_per_scan"),
    ],
)
def test_sigmf_that_does_not_fit_names_the_field(
    key: str, value: object, rule: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    meta, _ = capture(tmp_path)
    content = json.loads(meta.read_text())
    content["global"][key] = value
    if value is None:
        del content["global"][key]
    meta.write_text(json.dumps(content))
    assert main(["import", "sigmf", str(meta), "--out", str(tmp_path / "a.mcap")]) == 2
    error = capsys.readouterr().err
    assert rule in error
    assert meta.name in error
    assert not (tmp_path / "a.mcap").exists()


def test_sigmf_that_was_cut_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    meta, _ = capture(tmp_path)
    data = meta.with_suffix(".sigmf-data")
    data.write_bytes(data.read_bytes()[:-8])
    assert main(["import", "sigmf", str(meta), "--out", str(tmp_path / "a.mcap")]) == 2
    assert data.name in capsys.readouterr().err
    assert not (tmp_path / "a.mcap").exists()
