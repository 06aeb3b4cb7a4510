"""CAN logs as tools write them: channels, languages, encodings, and what unpacks without end."""

from __future__ import annotations

import gzip
import logging
import math
import struct
import zlib
from datetime import datetime
from pathlib import Path

import can
import pytest

from nodes.can.asc_header import plain_date
from nodes.can.log_file import read_log

FRAME = "   0.010000 1  123             Rx   d 8 0E 10 00 00 00 00 00 00\n"
HEAD = "base hex  timestamps absolute\ninternal events logged\n"


def bus_log(path: Path) -> Path:
    """Channel 1 carries 1, channel 2 carries 2, as the file counts them."""
    with can.Logger(path) as logger:
        for number in (1, 2, 1, 2):
            logger(can.Message(timestamp=1.7e9, arbitration_id=5, data=[number], channel=number - 1))
    return path


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".asc.gz"])
def test_channels_are_counted_as_in_the_file(tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture) -> None:
    path = bus_log(tmp_path / f"two{suffix}")
    for channel in ("1", "2"):
        assert [(item.frame.data[0], item.frame.channel) for item in read_log(path, channel)] == [
            (int(channel),) * 2
        ] * 2
    with pytest.raises(ValueError, match=rf"two{suffix}: holds no frames of channel 0; its channels are 1, 2$"):
        list(read_log(path, "0"))
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        assert len(list(read_log(path))) == 4
    assert "channels 1, 2 are read as one bus" in caplog.text


def test_a_log_that_names_no_channels_says_so(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"two\.csv: holds no frames of channel 1; it names no channels$"):
        list(read_log(bus_log(tmp_path / "two.csv"), "1"))


def test_channels_of_a_trc_are_the_files_own(tmp_path: Path) -> None:
    path = tmp_path / "two.trc"
    rows = [f"{2 * k + c}) {k}.0 {c} Rx 0123 - 1 0{c}\n" for k in range(2) for c in (1, 2)]
    path.write_text(";$FILEVERSION=1.3\n;$STARTTIME=43831,5\n" + "".join(rows))
    frames = list(read_log(path, "2"))
    assert [item.frame.data[0] for item in frames] == [2, 2]
    # a day and a half of 2020 in days of 1900, with the comma of a German machine: noon
    assert frames[0].stamp_ns == 1_577_880_000 * 10**9


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Sat Sep 30 15:06:13.191 pm 2017", (2017, 9, 30, 15, 6, 13.191)),
        ("Thu Apr 28 12:44:52 am 2022", (2022, 4, 28, 0, 44, 52.0)),
        ("Die Mär 1 09:00:00.5 2022", (2022, 3, 1, 9, 0, 0.5)),
        ("Tue Mar 1 09:00:00.123456789 2022", (2022, 3, 1, 9, 0, 0.123456)),
        ("mar. août 8 10:15:00.123 2023", (2023, 8, 8, 10, 15, 0.123)),
        ("jeu. juil. 7 10:15:00 p. m. 2023", (2023, 7, 7, 22, 15, 0.0)),
        ("07.08.2023 10:15:00", (2023, 8, 7, 10, 15, 0.0)),
        ("Mon 8/7/2023 10:15:00", None),
        ("Mon Feb 30 10:15:00 2023", None),
        ("somewhen", None),
    ],
)
def test_dates_of_other_languages(tmp_path: Path, text: str, expected: tuple | None) -> None:
    """A date that nobody can read leaves the frames and their order."""
    path = tmp_path / "a.asc"
    path.write_text(f"date {text}\n// a comment\n\n{HEAD}{FRAME}", encoding="utf-8")
    (read,) = read_log(path)
    assert (read.frame.arbitration_id, read.frame.data[:2]) == (0x123, b"\x0e\x10")
    start_s = 0.0
    if expected is not None:
        *fields, second = expected
        start_s = datetime(*fields).timestamp() + second
    assert math.isclose(1e-9 * read.stamp_ns, start_s + 0.01, abs_tol=1e-5)
    assert (plain_date(text) is None) == (expected is None)


def test_an_asc_whose_date_is_unknown_keeps_its_base_and_its_first_frame(tmp_path: Path) -> None:
    """291 is 0x123, 14 is 0x0E; the header says nothing of internal events."""
    path = tmp_path / "a.asc"
    path.write_text("date xx\nbase dec  timestamps absolute\n" + 2 * "   0.01 1  291             Rx   d 2 14 16\n")
    assert [(item.frame.arbitration_id, bytes(item.frame.data)) for item in read_log(path)] == [
        (0x123, b"\x0e\x10")
    ] * 2


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
@pytest.mark.parametrize("kind", [".asc", ".trc", ".log"])
def test_marks_and_encodings(tmp_path: Path, kind: str, encoding: str) -> None:
    content = {
        ".asc": f"date Thu May 20 10:15:00.123 2023\n{HEAD}// Prüfstand\n{FRAME}",
        ".trc": ";$FILEVERSION=1.1\n;$STARTTIME=43831.4\n;  C:\\München\n 1) 0.0 Rx 0123 8 0E 10 00 00 00 00 00 00\n",
        ".log": "(1600000000.000000) can0 123#0E10000000000000\n",
    }
    path = tmp_path / f"a{kind}"
    path.write_bytes(content[kind].encode(encoding))
    (read,) = read_log(path)
    assert (read.frame.arbitration_id, read.frame.data[:2]) == (0x123, b"\x0e\x10")


def blf(path: Path, *containers: bytes, cut: int = 0) -> Path:
    can.BLFWriter(path).stop()
    content = path.read_bytes()[:144]
    for container in containers:
        packed = struct.pack("<H6xL4x", 2, len(container)) + zlib.compress(container)[: -cut or None]
        content += struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16 + len(packed), 10) + packed + b"\0" * (len(packed) % 4)
    path.write_bytes(content)
    return path


def object_of_blf(at: int) -> bytes:
    head = struct.pack("<4sHHLLLHHQ", b"LOBJ", 32, 1, 48, 1, 2, 0, 0, at)
    return head + struct.pack("<HBBL8s", 1, 0, 8, 5, bytes(8))


def test_a_container_of_a_blf_is_not_unpacked_beyond_its_limit(tmp_path: Path) -> None:
    """64 MiB of zeros in 64 KiB."""
    with pytest.raises(
        ValueError, match=r"after 0 frames: ValueError: a container must unpack to at most 4194304 bytes"
    ):
        list(read_log(blf(tmp_path / "zeros.blf", bytes(1 << 26))))


def test_a_blf_that_is_cut_off_says_so(tmp_path: Path) -> None:
    path = blf(tmp_path / "cut.blf", b"".join(map(object_of_blf, range(100))))
    assert len(list(read_log(path))) == 100
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"cut\.blf: cannot be read after 0 frames: ValueError: ends within an object"):
        list(read_log(path))
    with pytest.raises(ValueError, match="ends within a zlib stream"):
        list(read_log(blf(path, b"".join(map(object_of_blf, range(100))), cut=4)))


def test_a_packed_log_is_not_unpacked_without_end(tmp_path: Path) -> None:
    path = tmp_path / "endless.log.gz"
    with gzip.open(path, "wb") as file:
        file.write((b" " * 4095 + b"\n") * 4096)
    with pytest.raises(ValueError, match="unpacks to more than 8388608 bytes"):
        list(read_log(path))
