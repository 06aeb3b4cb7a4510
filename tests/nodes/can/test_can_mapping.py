"""Mapping files: what is wrong with one is a line that names file, field, value and rule."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import msgspec
import pytest

from mirrorwave.cli import main
from models.vehicle.can_mapping import CanMapping, DbcRange, MessageRule, QuantityRule, SignRule, WheelSpeedsRule
from models.vehicle.end_to_end import Algorithm, ChecksumRule, CounterRule
from nodes.can.bus import load_decoder, load_mapping
from nodes.process.launch_file import parse_yaml

GOOD = """speed: {message: MW_SPEED, signals: [SPEED], low: -80.0, high: 80.0}
yaw_rate: {message: MW_MOTION, signals: [YAW_RATE], low: -2.0, high: 2.0}
messages:
  MW_SPEED: {period_s: 0.02, checksum: {signal: SPEED_CHECKSUM}, counter: {signal: SPEED_COUNTER}}
"""
DBC = Path("launch/can/mirrorwave.dbc")
QUANTITY = "message, signals, combine, unit, scale, offset, sign, negative_while, dbc_range, low, high"


def refused(tmp_path: Path, old: str, new: str) -> str:
    """What is said of the good mapping with a change, the file's name taken off."""
    assert old in GOOD
    path = tmp_path / "car.yaml"
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(ValueError, match=r"car\.yaml: ") as caught:
        load_decoder(DBC, path)
    said = str(caught.value)
    assert "\n" not in said
    return said.removeprefix(f"{path}: ")


def test_the_mapping_itself_is_good(tmp_path: Path) -> None:
    path = tmp_path / "car.yaml"
    path.write_text(GOOD)
    assert not load_decoder(DBC, path).warnings


@pytest.mark.parametrize(
    ("value", "shown"),
    [(".inf", "inf"), ("-.inf", "-inf"), (".nan", "nan"), ("0", "0.0"), ("-0.02", "-0.02"), ("1e300", "1e+300"),
     ("1e-12", "1e-12")],
)  # fmt: skip
def test_a_period_that_is_none(tmp_path: Path, value: str, shown: str) -> None:
    said = refused(tmp_path, "period_s: 0.02", f"period_s: {value}")
    assert said == f"messages.MW_SPEED: period_s must be 1e-06..86400 s, got {shown}"


@pytest.mark.parametrize(
    ("old", "new", "field", "known"),
    [
        ("low: -80.0", "lo: -80.0", "speed.lo", QUANTITY),
        ("period_s", "period", "messages.MW_SPEED.period", "period_s, checksum, counter"),
        ("{signal: SPEED_CHECKSUM}", "{signals: SPEED_CHECKSUM}", "messages.MW_SPEED.checksum.signals",
         "signal, algorithm, data_id"),
        ("yaw_rate:", "yawrate:", "yawrate", "speed, yaw_rate, steering, wheel_speeds, messages"),
        ("{signal: SPEED_CHECKSUM}", "{signal: SPEED_CHECKSUM, algorithm: crc16}",
         "messages.MW_SPEED.checksum.algorithm", "crc8_sae_j1850, xor8, sum8"),
        ("low: -80.0", "combine: add, low: -80.0", "speed.combine", "mean, sum"),
        ("low: -80.0", "dbc_range: counts, low: -80.0", "speed.dbc_range", "auto, physical, raw, ignore"),
        ("low: -80.0", "negative_while: {message: A, signal: B, value: 1}, low: -80.0",
         "speed.negative_while.value", "message, signal, values"),
    ],
)  # fmt: skip
def test_what_a_mapping_does_not_know_is_listed(tmp_path: Path, old: str, new: str, field: str, known: str) -> None:
    said = refused(tmp_path, old, new)
    assert said.startswith(f"{field}: unknown ")
    # a suggestion may follow
    assert re.search(rf"; known are {re.escape(known)}(; did you mean '\w+'\?)?$", said)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("low: -2.0", "low: .nan", "yaw_rate: low must be below high, both finite, got nan and 2.0"),
        ("low: -2.0", "unit: furlong, low: -2.0", "yaw_rate: unit must be one of m/s, "),
        ("low: -2.0", "scale: .inf, low: -2.0", "yaw_rate: scale must be finite and not zero, got inf"),
        ("[YAW_RATE]", "[]", "yaw_rate: signals must name at least one signal"),
        ("[YAW_RATE]", "[YAW_RATE, YAW_RATE]", "yaw_rate: signals must name each signal once, got YAW_RATE, YAW_RATE"),
        ("[YAW_RATE]", "[STEERING_WHEEL_ANGLE]", "yaw_rate.unit: must be of rad/s, deg/s, mrad/s; "),
        ("low: -2.0", "scale: 0.0174, low: -2.0", "yaw_rate.scale: must be within 10 % of 1, which makes rad/s rad/s"),
        ("SPEED_COUNTER}", "SPEED_COUNTER, max_step: 0}", "messages.MW_SPEED.counter: max_step must be at least 1"),
        ("messages:", "wheel_speeds: {message: MW_SPEED, left: [], right: [SPEED]}\nmessages:",
         "wheel_speeds: left must name at least one signal"),
        ("messages:", "wheel_speeds: {message: MW_SPEED, left: [SPEED], right: [GONE]}\nmessages:",
         "wheel_speeds.signals: message MW_SPEED of the DBC has no signal 'GONE'"),
    ],
)  # fmt: skip
def test_values_that_make_no_sense(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert refused(tmp_path, old, new).startswith(said)


def test_a_missing_part_is_named(tmp_path: Path) -> None:
    path = tmp_path / "car.yaml"
    path.write_text("speed: {message: MW_SPEED, signals: [SPEED], low: -80.0, high: 80.0}\n")
    with pytest.raises(ValueError, match=r"car\.yaml: .*missing required field yaw_rate"):
        load_mapping(path)


def test_numbers_of_a_sign_signal() -> None:
    """A gear lever: 2 is reverse, the other gears are not; without a list every number but zero is."""
    gear = SignRule(message="GEARS", signal="GEAR", values=(2, 7))
    assert [gear.is_negative(value) for value in (0.0, 1.0, 2.0, 7.0, None)] == [False, False, True, True, False]
    flag = SignRule(message="GEARS", signal="REVERSE")
    assert [flag.is_negative(value) for value in (0.0, 1.0, 3.0, None)] == [False, True, True, False]


def test_the_page_documents_the_whole_format() -> None:
    """Every field, choice and algorithm of the mapping stands on the page, as code."""
    page = Path("docs/guides/connect-my-car.md").read_text(encoding="utf-8")
    parts = (CanMapping, QuantityRule, WheelSpeedsRule, MessageRule, SignRule)
    names = {field.encode_name for part in parts for field in msgspec.structs.fields(part)}
    names |= {f"checksum.{field.encode_name}" for field in msgspec.structs.fields(ChecksumRule)}
    names |= {f"counter.{field.encode_name}" for field in msgspec.structs.fields(CounterRule)}
    names |= {*DbcRange, *get_args(Algorithm), "mean", "sum"}
    # these stand in the example of a sign signal, or are the names of whole parts
    names -= {"signal", "values", "checksum", "counter"}
    assert not [name for name in sorted(names) if f"`{name}`" not in page]
    example = page.split("```yaml\n")[1].split("```")[0]
    committed = Path("launch/can/raw_ranges.yaml").read_text(encoding="utf-8")
    assert parse_yaml(example, "page") == parse_yaml(committed, "file")


def test_the_verb_says_it_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "car.yaml"
    path.write_text(GOOD.replace("period_s: 0.02", "period_s: .inf"))
    log = tmp_path / "drive.log"
    log.write_text("(1700000000.000000) can0 100#0000000000000000\n")
    assert main(["can", "decode", str(log), "--mapping", str(path)]) == 2
    said = capsys.readouterr().err
    assert said == f"mirrorwave: {path}: messages.MW_SPEED: period_s must be 1e-06..86400 s, got inf\n"
