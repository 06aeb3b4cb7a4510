"""`mirrorwave import xradarnlos`, then `mirrorwave eval` on what it wrote."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mirrorwave.cli import main


def write_captures(folder: Path, count: int) -> None:
    """Maps with two bright returns, a direct one 30 m ahead and an image at 50 m, of a thing at 10 m."""
    folder.mkdir()
    for index in range(count):
        rng = np.random.default_rng(index)
        values = rng.standard_normal((512, 256, 2)) @ np.array([1.0, 1.0j])
        values[139:142, 118:138] = 300.0
        values[233:236, 118:138] = 100.0
        np.save(folder / f"{index}.npy", values)
        direct, image, place = (np.array([[0.0], [y], [0.0]]) for y in (30.0, 50.1, 10.0))
        np.savez(folder / f"{index}.npz", L=direct, G=image, T=place)


def test_imported_captures_can_be_evaluated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_captures(tmp_path / "in", 3)
    out = str(tmp_path / "data")
    assert main(["import", "xradarnlos", str(tmp_path / "in"), "--out", out, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["frames"], said["los_points"], said["mirrored_points"], said["broken"]) == (3, 3, 3, [])
    words = ["eval", "--data", out, "--split", "all", "--method", "cfar-nlos,geometry=published", "--json"]
    assert main(words) == 0
    report = json.loads(capsys.readouterr().out)
    measured = report["methods"][0]["measures"]["thinned"]
    assert report["frames"] == 3
    assert measured["dense_los_recall"][0] == 1.0
    assert measured["dense_mirrored_recall"][0] == 1.0
    assert measured["recovered_1m_recall"][0] == 1.0


def test_broken_captures_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Refused by name and code 2; with --skip-broken counted, named, and code 3."""
    write_captures(tmp_path / "in", 3)
    (tmp_path / "in" / "1.npz").write_bytes(b"PK nothing")
    words = ["import", "xradarnlos", str(tmp_path / "in"), "--out"]
    assert main([*words, str(tmp_path / "a")]) == 2
    assert f"{tmp_path / 'in' / '1.npz'}: must be a readable numpy file" in capsys.readouterr().err
    assert main([*words, str(tmp_path / "b"), "--skip-broken", "--json"]) == 3
    captured = capsys.readouterr()
    assert json.loads(captured.out)["frames"] == 2
    assert "left out" in captured.err


def test_options_are_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_captures(tmp_path / "in", 1)
    words = ["import", "xradarnlos", str(tmp_path / "in"), "--out", str(tmp_path / "a")]
    assert main(["import", "xradarnlos", str(tmp_path / "nowhere"), "--out", str(tmp_path / "a")]) == 2
    assert main([*words, "--kind", "real"]) == 2
    assert "must hold captures (welch_interpolated_background_subtracted.npz)" in capsys.readouterr().err
