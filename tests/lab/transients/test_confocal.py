"""The reader of confocal transients: what it gives, and one line for every file that is none."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from lab.transients.confocal import MAX_FILE_BYTES, read_confocal
from tests.captures import DATA, needs

CHART = DATA / "spad_cnlos" / "data_dot_chart_40cm.mat"
COUNTS = np.arange(4 * 4 * 32, dtype=np.uint16).reshape(4, 4, 32)


def written(path: Path, **fields: object) -> Path:
    savemat(path, {"rect_data": COUNTS, "width": 0.2, **fields})
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32, np.int64, np.float32, np.float64])
def test_counts_of_any_whole_type_are_read(tmp_path: Path, dtype: type) -> None:
    scan = read_confocal(written(tmp_path / "a.mat", rect_data=(COUNTS % 200).astype(dtype)))
    assert scan.counts.dtype == np.uint32
    assert np.array_equal(scan.counts, COUNTS % 200)
    assert (scan.half_width_m, scan.bin_s) == (0.2, 4e-12)


def test_a_file_of_any_name_is_read(tmp_path: Path) -> None:
    assert read_confocal(written(tmp_path / "a.mat").rename(tmp_path / "capture")).bins == 32


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"rect_data": COUNTS[:3]}, r"rect_data must have shape \(points, points, bins\), got \(3, 4, 32\)"),
        ({"rect_data": COUNTS[0]}, r"rect_data must have shape \(points, points, bins\), got \(4, 32\)"),
        ({"rect_data": COUNTS[..., :8]}, r"at least 2 points a side and 16 bins, got \(4, 4, 8\)"),
        ({"rect_data": COUNTS - 300.0}, r"rect_data must lie in 0\.\.4294967295, got -300"),
        ({"rect_data": np.where(COUNTS == 7, np.nan, COUNTS)}, "rect_data must be finite, got 1 counts that are not"),
        ({"rect_data": np.where(COUNTS == 7, np.inf, COUNTS)}, "rect_data must be finite"),
        ({"rect_data": COUNTS * 1e9}, r"rect_data must lie in 0\.\.4294967295, got 511"),
        ({"rect_data": COUNTS + 0.5}, r"rect_data must be whole numbers of photons, got 0\.5"),
        ({"rect_data": COUNTS * 1j}, "rect_data must be real numbers"),
        ({"rect_data": "counts"}, "rect_data must be an array of numbers, got class 'char'"),
        ({"rect_data": {"a": 1}}, "rect_data must be an array of numbers, got class 'struct'"),
        ({"width": 0.0}, r"width must be finite and positive, got 0\.0"),
        ({"width": np.nan}, "width must be finite and positive, got nan"),
        ({"width": -0.2}, "width must be finite and positive"),
        ({"width": 1e30}, r"half_width_m must lie in 0\.\.1000"),
        ({"width": [0.2, 0.2]}, r"width must be a single number, got shape \(1, 2\)"),
        ({"width": "wide"}, "width must be an array of numbers"),
    ],
)
def test_wrong_fields_are_refused_by_name(tmp_path: Path, fields: dict, message: str) -> None:
    path = written(tmp_path / "a.mat", **fields)
    with pytest.raises(ValueError, match=message) as refused:
        read_confocal(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["rect_data", "width"])
def test_a_missing_field_is_named(tmp_path: Path, name: str) -> None:
    savemat(tmp_path / "a.mat", {key: value for key, value in (("rect_data", COUNTS), ("width", 0.2)) if key != name})
    with pytest.raises(ValueError, match=f"{name} is missing, the file holds "):
        read_confocal(tmp_path / "a.mat")


@pytest.mark.parametrize("packed", [False, True], ids=["plain", "packed"])
def test_a_cut_file_is_refused_wherever_it_ends(tmp_path: Path, packed: bool) -> None:
    savemat(tmp_path / "a.mat", {"width": 0.2, "rect_data": COUNTS}, do_compression=packed)
    content = (tmp_path / "a.mat").read_bytes()
    for length in range(0, len(content) - 8, 29):
        (tmp_path / "cut.mat").write_bytes(content[:length])
        with pytest.raises(ValueError, match=r"cut\.mat: "):
            read_confocal(tmp_path / "cut.mat")


@pytest.mark.parametrize("content", [b"\x89HDF\r\n\x1a\n" + bytes(600), b"a text\n" * 99, b"MATLAB 7.3 MAT-file" * 40])
def test_a_file_of_another_kind_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.mat: must be a whole MATLAB file of version 5 to 7"):
        read_confocal(tmp_path / "a.mat")


def test_a_huge_file_and_huge_arrays_are_refused_before_they_are_read(tmp_path: Path) -> None:
    with (tmp_path / "a.mat").open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)
    with pytest.raises(ValueError, match=r"a\.mat: must hold at most \d+ bytes"):
        read_confocal(tmp_path / "a.mat")
    savemat(tmp_path / "b.mat", {"rect_data": np.zeros((64, 64, 4097), np.uint8), "width": 0.2}, do_compression=True)
    with pytest.raises(ValueError, match="rect_data must hold at most 16777216 counts"):
        read_confocal(tmp_path / "b.mat")


def test_a_name_of_a_gigabyte_is_refused(tmp_path: Path) -> None:
    """A megabyte of packed zeros took two gigabytes."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data

    numbers = element(6, struct.pack("<II", 6, 0)) + element(5, struct.pack("<ii", 1, 1))
    packed = zlib.compress(element(14, numbers + element(1, b"a" * (800 << 20)) + element(9, bytes(8))))
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM"
    (tmp_path / "a.mat").write_bytes(head + element(15, packed))
    with pytest.raises(ValueError, match=r"a\.mat: must be a whole MATLAB file of version 5 to 7: MemoryError"):
        read_confocal(tmp_path / "a.mat")


@needs(CHART)
def test_the_real_chart() -> None:
    scan = read_confocal(CHART)
    assert scan.counts.shape == (64, 64, 2048)
    assert scan.half_width_m == 0.2
    assert int(scan.counts.sum(dtype=np.uint64)) == 238_739_454
