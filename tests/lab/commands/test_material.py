"""`mirrorwave sim material`: the JSON contract, both bands, refusals in one line, the picture."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer

from lab.commands.material import material
from lab.full_wave.rough import RoughParams
from lab.walls.curves import parse_angles
from mirrorwave.console import error_line, exit_code_of
from models.physics.fresnel import slab_reflection, slab_transmission, stack_reflection, stack_transmission
from models.physics.materials import permittivity, wall_layers

WAVELENGTH_M = 299_792_458.0 / 10e9


def run(line: str) -> None:
    app = typer.Typer()
    app.command()(material)
    app(args=line.split(), standalone_mode=False)


def answer_of(line: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    run(f"{line} --json")
    return json.loads(capsys.readouterr().out)


def as_complex(pairs: list[list[float]]) -> np.ndarray:
    return np.array(pairs) @ np.array([1.0, 1.0j])


def test_json_is_the_contract(capsys: pytest.CaptureFixture[str]) -> None:
    """40 cm of concrete, 0.5 mm rough: exact keys, and curves equal to the slab's."""
    found = answer_of("concrete --thickness-mm 400 --roughness-mm 0.5 --angles-deg 0:80:20", capsys)
    keys = ["material", "frequency_hz", "thickness_m", "roughness_m", "method", "angles_deg", "te", "tm"]
    assert list(found) == keys
    assert [found[key] for key in keys[:6]] == ["concrete", 10e9, 0.4, 5e-4, "exact", [0.0, 20.0, 40.0, 60.0, 80.0]]
    cosine = np.cos(np.radians(found["angles_deg"]))
    slab = (permittivity("concrete", 10e9), cosine, 0.4, WAVELENGTH_M)
    for polarisation in ("te", "tm"):
        curves = found[polarisation]
        assert list(curves) == ["r", "t", "specular_gain"]
        r = as_complex(curves["r"])
        np.testing.assert_allclose(r, slab_reflection(*slab, polarisation), rtol=1e-12)
        np.testing.assert_allclose(as_complex(curves["t"]), slab_transmission(*slab, polarisation), rtol=1e-9)
        left = np.exp(-np.square(4.0 * np.pi * 5e-4 * cosine / WAVELENGTH_M))
        np.testing.assert_allclose(curves["specular_gain"], np.abs(r) ** 2 * left, rtol=1e-12)


def test_half_space_has_no_thickness_and_lets_nothing_through(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer_of("glass --frequency-ghz 77 --angles-deg 0:0:1", capsys)
    assert found["thickness_m"] is None
    assert found["te"]["t"] == [[0.0, 0.0]]


def test_a_construction_states_its_whole_thickness(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer_of("double-glazing --angles-deg 30:30:1", capsys)
    assert found["thickness_m"] == pytest.approx(24e-3)
    media, thicknesses = zip(*wall_layers("double_glazing", None, 10e9), strict=True)
    expected = stack_reflection(media, thicknesses, np.cos(np.radians(30.0)), WAVELENGTH_M, "tm")
    assert as_complex(found["tm"]["r"])[0] == pytest.approx(complex(expected))


def test_people_see_both_bands(capsys: pytest.CaptureFixture[str]) -> None:
    run("concrete --roughness-mm 0.5 --angles-deg 0:45:45")
    out = capsys.readouterr().out
    assert "concrete (half-space) at 10 GHz, roughness 0.5 mm (usual 0.2..0.5), exact" in out
    assert "concrete (half-space) at 77 GHz" in out
    assert out.count("tm_gain_db") == 2
    # what 0.5 mm cost at normal incidence: 0.19 dB at 10 GHz, 11.3 dB at 77 GHz
    assert [line.split()[3] for line in out.splitlines() if line.split()[0] == "0"] == ["-8.29", "-19.4"]


def test_a_band_outside_the_table_is_left_out_and_said(capsys: pytest.CaptureFixture[str]) -> None:
    run("plywood --angles-deg 0:0:1")
    out = capsys.readouterr().out
    assert "77 GHz: not known for plywood; --extrapolate shows it all the same" in out
    assert "plywood (half-space) at 77 GHz" not in out
    run("plywood --angles-deg 0:0:1 --extrapolate")
    out = capsys.readouterr().out
    assert "at 77 GHz, roughness 0 mm, exact, extrapolated beyond 1..40 GHz, R within 1.44 dB" in out
    assert "at 10 GHz, roughness 0 mm, exact\n" in out


def test_a_band_between_two_measured_ones_is_shown_with_its_error(capsys: pytest.CaptureFixture[str]) -> None:
    run("brick --angles-deg 0:0:1")
    out = capsys.readouterr().out
    text = "brick (half-space) at 77 GHz, roughness 0 mm (usual 0.5..1.5), exact, interpolated between 40 and 110 GHz"
    assert f"{text}, R within 0.23 dB\n" in out
    assert "not known" not in out


def test_extrapolation_leaves_json_alone_and_is_said_beside_it(capsys: pytest.CaptureFixture[str]) -> None:
    run("asphalt --frequency-ghz 77 --extrapolate --json")
    output = capsys.readouterr()
    assert json.loads(output.out)["material"] == "asphalt"
    assert output.err == "mirrorwave: asphalt at 77 GHz: extrapolated beyond 7..30 GHz, R within 1.07 dB\n"


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("cheese", "unknown material 'cheese', known are vacuum, concrete"),
        ("brick --frequency-ghz 400", "brick is known for 1..40 and 110..330 GHz, got 400 GHz"),
        ("concrete --frequency-ghz nan", "frequency_hz must be finite and positive, got nan"),
        ("concrete --json --frequency-ghz 10 --frequency-ghz 77", "--json answers one --frequency-ghz, got 2"),
        ("concrete --angles-deg 0:95:5", "--angles-deg must rise within 0..90 by a positive step, got '0:95:5'"),
        ("concrete --angles-deg 0:60:nan", "--angles-deg must rise within 0..90"),
        ("concrete --angles-deg 0:60", "--angles-deg must be FIRST:LAST:STEP, got '0:60'"),
        ("concrete --angles-deg 0:90:1e-6", "--angles-deg must be at most 10000 angles, got 90000001"),
        ("concrete --thickness-mm -3", "--thickness-mm must be positive, got -3.0"),
        ("concrete --thickness-mm 0", "--thickness-mm must be positive, got 0.0"),
        ("window --thickness-mm 3", "--thickness-mm must not be given for window"),
        ("concrete --roughness-mm -1", "--roughness-mm must not be negative, got -1.0"),
        ("vegetation", "vegetation is a volume: it needs --thickness-mm"),
        ("hedge --thickness-mm 900 --roughness-mm 1", "takes no --roughness-mm"),
        ("hedge --thickness-mm 900 --method fdtd", "is no case for fdtd"),
    ],
)
def test_bad_input_is_one_line_and_code_2(line: str, text: str) -> None:
    with pytest.raises(ValueError) as caught:
        run(line)
    assert exit_code_of(caught.value) == 2
    assert text in error_line(caught.value)


def test_angles_hold_both_ends() -> None:
    np.testing.assert_allclose(parse_angles("0:85:5"), np.arange(0.0, 86.0, 5.0))
    np.testing.assert_allclose(parse_angles("0:0.3:0.1"), [0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(parse_angles("0:10:4"), [0.0, 4.0, 8.0])


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """A stand-in for the wave simulation: exact, and it notes what it was asked."""
    calls: list[dict[str, Any]] = []

    def reflect(layers: Any, angle_rad: float, frequency_hz: float, polarisation: Any, settings: RoughParams) -> Any:
        asked = {"layers": layers, "angle_rad": angle_rad, "frequency_hz": frequency_hz, "polarisation": polarisation}
        calls.append({**asked, **asdict(settings)})
        media, thicknesses = zip(*layers, strict=True)
        args = (media, thicknesses, np.cos(angle_rad), 299_792_458.0 / frequency_hz, polarisation)
        return SimpleNamespace(
            r=complex(stack_reflection(*args)),
            t=complex(stack_transmission(*args)),
            specular_power=0.25,
            reflected_power=0.5,
        )

    monkeypatch.setattr("lab.full_wave.scattering.reflect", reflect)
    return calls


@pytest.mark.slow
def test_fdtd_is_asked_angle_by_angle(
    simulated: list[dict[str, Any]], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    line = "glass --thickness-mm 6 --roughness-mm 0.1 --angles-deg 0:60:30"
    exact, found = answer_of(line, capsys), answer_of(f"{line} --method fdtd", capsys)
    assert found["method"] == "fdtd"
    assert [call["polarisation"] for call in simulated] == ["te"] * 3 + ["tm"] * 3
    assert [call["angle_rad"] for call in simulated[:3]] == pytest.approx([0.0, np.pi / 6.0, np.pi / 3.0])
    assert simulated[0]["layers"] == wall_layers("glass", 6e-3, 10e9)
    assert simulated[0]["roughness_m"] == pytest.approx(1e-4)
    np.testing.assert_allclose(as_complex(found["te"]["r"]), as_complex(exact["te"]["r"]))
    # the lobe's energy is the simulation's own
    assert found["te"]["specular_gain"] == [0.25, 0.25, 0.25]
    run(f"{line} --method fdtd --plot {tmp_path / 'a.png'}")
    assert (tmp_path / "a.png").stat().st_size > 10_000


@pytest.mark.slow
@pytest.mark.parametrize(
    "line", ["concrete --thickness-mm 400 --roughness-mm 0.5", "metal", "vacuum", "hedge --thickness-mm 900"]
)
def test_pictures_are_drawn_and_repeat(line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Also of what reflects nothing or lets nothing through; equal questions give equal bytes."""
    for name in ("a.png", "b.png"):
        run(f"{line} --angles-deg 0:80:40 --plot {tmp_path / name}")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert str(tmp_path / "a.png") in capsys.readouterr().out


def test_a_picture_needs_a_folder(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        run(f"metal --angles-deg 0:1:1 --plot {tmp_path / 'none' / 'a.png'}")
    assert exit_code_of(caught.value) == 2
    assert "a.png: No such file" in error_line(caught.value)


def test_without_a_name_all_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    run("")
    assert "double_glazing" in capsys.readouterr().out
    run("--json")
    rows = json.loads(capsys.readouterr().out)
    assert {row["material"] for row in rows} >= {"concrete", "window", "asphalt", "vegetation"}
