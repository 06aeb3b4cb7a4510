"""Plain values of YAML 1.2: what is a number, what is text, and what is written so that it reads back."""

from __future__ import annotations

import pytest
import yaml

from msgs.files.yaml_loader import BoundedLoader, PlainDumper


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-07", 1e-7),
        ("1e5", 1e5),
        ("1E5", 1e5),
        (".5e-3", 5e-4),
        ("-1.e2", -100.0),
        ("+3", 3),
        ("0x1f", 31),
        (".inf", float("inf")),
        ("12:30", "12:30"),
        ("1:2:3.5", "1:2:3.5"),
        ("2026-01-01", "2026-01-01"),
        ("off", "off"),
        ("e5", "e5"),
        ("1e", "1e"),
        ("true", True),
        ("~", None),
    ],
)
def test_plain_values_are_those_of_yaml_1_2_and_read_back(text: str, value: object) -> None:
    read = yaml.load(f"a: {text}", Loader=BoundedLoader)["a"]
    assert (read, type(read)) == (value, type(value))
    for content in ({"a": value}, {"a": text}):
        written = yaml.dump(content, Dumper=PlainDumper)
        assert yaml.load(written, Loader=BoundedLoader) == content
        if content["a"] == text:
            # readers of YAML 1.1 find the text too
            assert yaml.safe_load(written) == content


def test_a_file_name_that_is_not_utf_8_is_written_as_ascii() -> None:
    written = yaml.dump({"path": "w\udcfc/drive.mcap"}, Dumper=PlainDumper)
    assert written.encode("ascii") == b'path: "w\\uDCFC/drive.mcap"\n'


def test_half_a_megabyte_of_sexagesimal_digits_is_text() -> None:
    """Multiplied out it would be a number of 350,000 digits, and take a minute."""
    text = "1" + ":59" * 200_000
    assert yaml.load(text, Loader=BoundedLoader) == text
    with pytest.raises(yaml.YAMLError, match="more than 100000 keys and values"):
        yaml.load(f"[{'1,' * 100_001}]", Loader=BoundedLoader)


def test_libyaml_reads_the_text() -> None:
    """In Python alone a megabyte takes seconds."""
    assert issubclass(BoundedLoader, yaml.CSafeLoader)
