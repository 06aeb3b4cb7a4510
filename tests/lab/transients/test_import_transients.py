"""`mirrorwave import transients`: a point scatterer through files and command line, refusals, a real scan."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from mirrorwave.cli import main
from tests.captures import DATA, needs
from tests.lab.transients.scans import point_scan

SIGN = DATA / "spad_cnlos" / "data_exit_sign.mat"
DEPTH_M = 0.30


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    savemat(tmp_path / "point.mat", {"rect_data": point_scan((0.0125, 0.0125, DEPTH_M)).counts, "width": 0.2})
    return tmp_path / "point.mat"


def arguments(capture: Path, out: Path, *more: str) -> list[str]:
    return ["import", "transients", str(capture), "--out", str(out), "--bin-ps", "16", *more]


def test_a_point_becomes_picture_arrays_and_summary(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(arguments(capture, out, "--min-range-m", "0.1")) == 0
    assert sorted(path.name for path in out.iterdir()) == ["hidden.npz", "hidden.png", "summary.json"]
    summary = json.loads((out / "summary.json").read_text())
    assert abs(summary["distance_m"] - DEPTH_M) < 0.005
    assert (summary["points"], summary["bins"], summary["half_width_m"]) == ([16, 16], 256, 0.2)
    assert summary["falloff"] == "retroreflective"
    with np.load(out / "hidden.npz") as arrays:
        assert np.unravel_index(arrays["brightness"].argmax(), (16, 16)) == (8, 8)
        assert arrays["depth_m"][8, 8] == pytest.approx(DEPTH_M, abs=0.005)


def test_same_bytes_twice(capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = []
    for name in ("a", "b"):
        assert main(arguments(capture, tmp_path / name, "--falloff", "matt", "--json", "--min-range-m", "0.1")) == 0
        printed.append(json.loads(capsys.readouterr().out) | {"folder": ""})
    assert printed[0] == printed[1]
    for name in ("summary.json", "hidden.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--min-range-m", "5"), "range must lie in 0..0.61"),
        (("--min-range-m", "-1"), "min_range_m must be finite and not negative, got -1.0"),
        (("--min-range-m", "nan"), "min_range_m must be finite"),
        (("--min-range-m", "0.6"), "got a dark volume"),
        (("--bin-ps", "0"), "bin_s must lie in"),
        (("--bin-ps", "inf"), "bin_s must lie in"),
    ],
)
def test_parameters_out_of_range(
    capture: Path, tmp_path: Path, more: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(capture, tmp_path / "out", *more)) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed
    assert not (tmp_path / "out").exists()


def test_a_full_folder_and_a_file_that_is_none(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments(capture, tmp_path)) == 2
    assert "must be a new or an empty folder" in capsys.readouterr().err
    (tmp_path / "text.mat").write_text("a text")
    assert main(arguments(tmp_path / "text.mat", tmp_path / "out")) == 2
    assert "text.mat: must be a whole MATLAB file" in capsys.readouterr().err
    assert main(arguments(tmp_path / "none.mat", tmp_path / "out")) == 2


@needs(SIGN)
def test_the_real_exit_sign(tmp_path: Path) -> None:
    """0.815 m is our own measurement, no truth: the file's name gives none."""
    assert main(["import", "transients", str(SIGN), "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["distance_m"] == pytest.approx(0.815, abs=0.005)
    assert summary["tilt_deg"] == pytest.approx(6.1, abs=0.3)
