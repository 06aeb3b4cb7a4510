"""`mirrorwave can`: what it prints, and the exit codes scripts rely on."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import msgspec
import pytest

from mirrorwave.cli import main
from msgs.values.vehicle import VehicleState
from nodes.can.bus import load_dbc, load_mapping
from sim_player.car import SimulatedCar
from tests.captures import DATA, needs
from tests.models.perception.track.test_yaw_rate_bias import drive, town, turns

DBC, MAPPING = Path("launch/can/mirrorwave.dbc"), Path("launch/can/mirrorwave.yaml")
RAW_DBC, RAW_MAPPING = Path("launch/can/raw_ranges.dbc"), Path("launch/can/raw_ranges.yaml")
REAL = DATA / "can_motec_subaru"


def write_drive(path: Path, seconds: int = 3) -> Path:
    """A car at 9 m/s; from 1.0 to 1.4 s its speed frames are corrupt, at 2.0 s one is out of range."""
    car = SimulatedCar(load_dbc(DBC), load_mapping(MAPPING))
    with can.Logger(path) as logger:
        for now_ns in range(0, seconds * 10**9, 20_000_000):
            state = VehicleState(stamp_ns=now_ns, speed_mps=99.0 if now_ns == 2 * 10**9 else 9.0, yaw_rate_rps=0.1)
            for frame in car.frames(state):
                data = bytearray(frame.data)
                if frame.arbitration_id == 0x100 and 10**9 <= now_ns < 14 * 10**8:
                    data[4] ^= 0xFF
                logger(
                    can.Message(
                        timestamp=1e-9 * now_ns + 1.7e9, arbitration_id=frame.arbitration_id, data=data, channel="can0",
                        is_extended_id=False,
                    )
                )  # fmt: skip
    return path


def run_json(capsys: pytest.CaptureFixture, *arguments: str) -> tuple[int, dict]:
    code = main(["can", "decode", *arguments, "--json"])
    return code, json.loads(capsys.readouterr().out)


def test_decode_flags_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_drive(tmp_path / "drive.log")
    code, report = run_json(capsys, str(log), "--every", "0.5")
    assert code == 0
    assert (report["frames"], report["loss"]) == (300, None)
    assert report["frames_by_verdict"]["wrong checksum"] == 20
    # one state each half second; that at 2.0 s is out of range, that after 1.0 s comes as the last good one expires
    assert [round(row["time_s"], 2) for row in report["states"]] == [0.0, 0.5, 1.18, 1.5, 2.0, 2.5]
    assert [row["valid"] for row in report["states"]] == [False, True, False, True, False, True]
    events = [(event["event"], round(event["from_s"], 2), event["count"]) for event in report["events"]]
    assert ("wrong checksum", 1.0, 20) in events
    assert ("out of range", 2.0, 1) in events
    # the last good speed came at 0.98 s and holds for ten periods
    assert any(name == "state not valid" and at_s == 1.18 for name, at_s, _ in events)
    assert all(row["speed_mps"] == 9.0 for row in report["states"] if row["valid"])
    # a table shows the first of many events, and says how many there are
    monkeypatch.setattr("mirrorwave.commands.captures.can._SHOWN_EVENTS", 1)
    assert main(["can", "decode", str(log)]) == 0
    assert f"... {len(events)} events in all" in capsys.readouterr().out


def write_raw_drive(path: Path) -> Path:
    """A minute in town without a standstill, the yaw rate 0.41 deg/s too low, by the DBC with ranges in raw counts."""
    car = SimulatedCar(load_dbc(RAW_DBC), load_mapping(RAW_MAPPING))
    with can.Logger(path) as logger:
        for state in drive(60.0, town, turns):
            for frame in car.frames(state):
                logger(
                    can.Message(
                        timestamp=1e-9 * state.stamp_ns + 1.7e9, arbitration_id=frame.arbitration_id, data=frame.data,
                        channel="can0", is_extended_id=False,
                    )
                )  # fmt: skip
    return path


@pytest.mark.slow
def test_decode_says_the_bias_and_what_of_the_dbc_was_not_taken_as_it_stands(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    log = write_raw_drive(tmp_path / "drive.log")
    words = [str(log), "--dbc", str(RAW_DBC), "--mapping", str(RAW_MAPPING)]
    code, report = run_json(capsys, *words)
    assert (code, report["state_count"] - report["valid_state_count"]) == (0, 2)
    (warning,) = report["warnings"]
    assert "the DBC's range 0..65535 of YAW_RATE is taken as raw counts" in warning
    bias = report["yaw_rate_bias"]
    assert bias["source"] == "driving"
    assert math.degrees(bias["rps"]) == pytest.approx(-0.41, abs=0.1)
    # as the DBC has it: turns to the right are refused, and the verb says what overrules it
    mapping = tmp_path / "car.yaml"
    mapping.write_text(RAW_MAPPING.read_text().replace("[YAW_RATE]", "[YAW_RATE], dbc_range: physical"))
    assert main(["can", "decode", str(log), "--dbc", str(RAW_DBC), "--mapping", str(mapping)]) == 0
    said = capsys.readouterr().out
    assert "is outside the DBC's 0..65535" in said
    assert "where the DBC's range of a signal is wrong, dbc_range of the mapping overrules it" in said
    # without steering and wheels nobody can tell the bias
    rows = RAW_MAPPING.read_text().splitlines()
    left_out = ("steering", "wheel_speeds", "  STEERING", "  WHEELS")
    mapping.write_text("\n".join(row for row in rows if not row.startswith(left_out)))
    assert main(["can", "decode", str(log), "--dbc", str(RAW_DBC), "--mapping", str(mapping)]) == 0
    said = capsys.readouterr().out
    assert "yaw rate bias is not observable: the vehicle never stood, and neither steering nor wheel speeds" in said


def test_decode_prints_tables(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["can", "decode", str(write_drive(tmp_path / "drive.blf"))]) == 0
    text = capsys.readouterr().out
    for part in (
        "SPEED_MPS",
        "wrong checksum",
        "SPEED gives 99, outside the mapping's -80..80",
        "300 frames in 2.98 s",
    ):
        assert part in text


@pytest.mark.slow
def test_exit_codes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = write_drive(tmp_path / "drive.log")
    # a log that breaks off: done with loss
    broken = tmp_path / "broken.log"
    broken.write_text(path.read_text() + "(1700000009.0) can0 nonsense\n")
    code, report = run_json(capsys, str(broken))
    assert (code, report["frames"]) == (3, 300)
    assert "broken.log: cannot be read after 300 frames" in report["loss"]
    # frames, but not of this car: failed
    other = tmp_path / "other.log"
    other.write_text("".join(f"({1700000000 + 0.01 * step:.6f}) can0 2B0#0011\n" for step in range(200)))
    code, report = run_json(capsys, str(other))
    assert (code, report["valid_state_count"]) == (1, 0)
    assert "wrong DBC?" in report["states"][-1]["reason"]
    # wrong usage or bad input
    assert main(["can", "decode", str(tmp_path / "gone.log")]) == 2
    assert main(["can", "decode", str(path), "--mapping", str(DBC)]) == 2
    assert main(["can", "decode", str(path), "--channel", "can9"]) == 2
    assert main(["can", "monitor", "--interface", "nothing"]) == 2
    assert main(["can", "monitor", "-i", "virtual", "--option", "port"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 5
    assert "gone.log" in errors[0]
    assert "holds no frames of channel can9" in errors[2]


def monitored(
    arguments: list[str], is_enough: Callable[[list[dict[str, Any]]], bool], capsys: pytest.CaptureFixture
) -> list[dict[str, Any]]:
    """What the monitor shows, asked again where car and monitor had no core within its time."""
    end_s = time.monotonic() + 120.0
    while True:
        code = main(arguments)
        rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        if code == 0 and is_enough(rows):
            return rows
        assert time.monotonic() < end_s, rows[-1:]


def test_monitor_shows_a_live_bus(capsys: pytest.CaptureFixture) -> None:
    """A car speaks on a virtual bus from another thread while the monitor listens."""
    stop = threading.Event()

    def speak() -> None:
        car = SimulatedCar(load_dbc(DBC), load_mapping(MAPPING), time.monotonic_ns())
        motion = VehicleState(stamp_ns=0, speed_mps=5.5)
        with can.Bus(interface="virtual", channel="monitor", ignore_config=True) as bus:
            while not stop.wait(0.005):
                for frame in car.frames(msgspec.structs.replace(motion, stamp_ns=time.monotonic_ns())):
                    bus.send(can.Message(arbitration_id=frame.arbitration_id, data=frame.data, is_extended_id=False))

    thread = threading.Thread(target=speak)
    thread.start()
    try:
        arguments = ["can", "monitor", "-i", "virtual", "-c", "monitor", "--duration", "1.0", "--every", "0.2"]
        rows = monitored([*arguments, "--json"], lambda rows: any(row["valid"] for row in rows), capsys)
    finally:
        stop.set()
        thread.join()
    assert {row["speed_mps"] for row in rows if row["valid"]} == {5.5}


def test_monitor_shows_every_signal_of_any_dbc(capsys: pytest.CaptureFixture) -> None:
    """Speed frames at 200 Hz, every tenth cut short, which changes no value; needs no mapping."""
    stop = threading.Event()

    def speak() -> None:
        car = SimulatedCar(load_dbc(DBC), load_mapping(MAPPING), time.monotonic_ns())
        sent = 0
        with can.Bus(interface="virtual", channel="signals", ignore_config=True) as bus:
            while not stop.wait(0.005):
                state = VehicleState(stamp_ns=time.monotonic_ns(), speed_mps=5.5)
                for frame in car.frames(state):
                    data = bytearray(frame.data)
                    sent += frame.arbitration_id == 0x100
                    if frame.arbitration_id == 0x100 and sent % 10 == 0:
                        del data[4:]
                    bus.send(can.Message(arbitration_id=frame.arbitration_id, data=data, is_extended_id=False))

    thread = threading.Thread(target=speak)
    thread.start()
    words = ["can", "monitor", "-i", "virtual", "-c", "signals", "--signals", "--mapping", "nowhere.yaml"]

    def verdicts(rows: list[dict[str, Any]]) -> set[str]:
        """Of speed frames, in what was shown last."""
        found = (row for row in rows[-1]["messages"] if row["message"] == "MW_SPEED") if rows else iter(())
        return set(next(found, {}).get("frames_by_verdict", {}))

    try:
        timed = ["--duration", "1.2", "--every", "0.3"]
        rows = monitored([*words, *timed, "--json"], lambda rows: len(verdicts(rows)) >= 2, capsys)
        assert main([*words, "--duration", "0.5", "--every", "0.2"]) == 0
    finally:
        stop.set()
        thread.join()
    speed = next(row for row in rows[-1]["messages"] if row["message"] == "MW_SPEED")
    assert speed["signals"]["SPEED"] == 5.5
    assert set(speed["frames_by_verdict"]) == {"ok", "wrong length"}
    assert rows[-1]["known_frames"] == rows[-1]["frames"] > 0
    assert "SPEED=5.5" in capsys.readouterr().out


def test_a_log_whose_time_goes_back_has_no_negative_period(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A clock that was set back between two drives in one file: the gaps of either count, the step does not.

    A gap of 100 ms among those of 20 ms is the longest, and no period; the last frame is older than the one before.
    """
    log = tmp_path / "back.log"
    frame = "can0 100#0000000000000000"
    log.write_text("".join(f"({at:.6f}) {frame}\n" for at in (100.0, 100.02, 100.12, 50.0, 50.02, 50.015)))
    code, report = run_json(capsys, str(log), "--signals")
    (row,) = report["messages"]
    assert (code, row["frames"], report["duration_s"]) == (0, 6, pytest.approx(0.16))
    assert (row["period_ms"], row["longest_gap_ms"]) == (pytest.approx(20.0), pytest.approx(100.0))


def test_monitor_of_a_silent_bus_fails(capsys: pytest.CaptureFixture) -> None:
    arguments = ["can", "monitor", "-i", "virtual", "-c", "silent", "-o", "rx_queue_size=10"]
    assert main([*arguments, "--duration", "0.4", "--every", "0.1"]) == 1
    assert "NOT VALID: speed: no MW_SPEED yet" in capsys.readouterr().out
    assert main([*arguments, "--duration", "0.4", "--every", "0.1", "--signals"]) == 1
    assert "0 of 0 frames are of this DBC" in capsys.readouterr().out


@pytest.mark.slow
@needs(REAL)
def test_decode_a_real_drive(capsys: pytest.CaptureFixture) -> None:
    code, report = run_json(
        capsys,
        str(REAL / "can_sample.log"),
        "--dbc",
        str(REAL / "sample_can_spec.dbc"),
        "--mapping",
        "launch/can/motec_sample.yaml",
        "--every",
        "0",
    )
    assert code == 0
    assert report["frames"] == 82558
    assert report["duration_s"] == pytest.approx(90.28, abs=0.01)
    assert max(row["speed_mps"] for row in report["states"]) == pytest.approx(36.0, abs=0.02)
    flagged = [event for event in report["events"] if event["event"] == "out of range"]
    assert [(event["message"], event["count"]) for event in flagged] == [("ID_D0", 71)]
