"""Permittivities of ITU-R P.2040 and the ranges they hold in."""

from __future__ import annotations

import csv
import math

import pytest

from models.physics.materials import (
    CONSTRUCTIONS,
    TABLE,
    VACUUM_PERMITTIVITY_F_PER_M,
    extrapolation_note,
    is_volume,
    material_name,
    permittivity,
    typical_roughness_mm,
    validity_ghz,
    wall_layers,
    wall_name,
    wall_names,
)
from tests.captures import DATA, needs

SHARED_TABLE = DATA / "itu_p2040" / "itu_p2040_table3.csv"


def test_concrete_at_10_ghz() -> None:
    """eps 5.24, sigma 0.280 S/m, loss tangent 0.096 (printed to 3 figures)."""
    concrete = permittivity("concrete", 10e9)
    assert concrete.real == pytest.approx(5.24)
    assert -concrete.imag / concrete.real == pytest.approx(0.09598, rel=1e-3)


@needs(SHARED_TABLE)
def test_every_row_of_the_table_agrees() -> None:
    with SHARED_TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 14
    for row in rows:
        medium = permittivity(row["material"], 10e9, extrapolate=True)
        sigma = -medium.imag * 2.0 * 3.141592653589793 * 10e9 * VACUUM_PERMITTIVITY_F_PER_M
        assert medium.real == pytest.approx(float(row["eps_r_at_10ghz"]), rel=2e-3), row["material"]
        assert sigma == pytest.approx(float(row["sigma_S_per_m_at_10ghz"]), rel=2e-3), row["material"]


def test_all_media_are_passive_at_both_ends_of_their_ranges() -> None:
    for name, rows in TABLE.items():
        for row in rows:
            for frequency_ghz in (row.min_ghz, row.max_ghz):
                assert permittivity(name, frequency_ghz * 1e9).imag <= 0.0


def test_ground_is_known_at_exactly_10_ghz_and_not_above() -> None:
    assert permittivity("wet_ground", 10e9).real == pytest.approx(11.94, abs=0.01)
    with pytest.raises(ValueError, match=r"wet_ground is known for 1\.\.10 GHz, got 10\.1 GHz"):
        permittivity("wet_ground", 10.1e9)


def test_out_of_range_only_on_request() -> None:
    with pytest.raises(ValueError, match=r"brick is known for 1\.\.40 and 110\.\.330 GHz, got 77 GHz"):
        permittivity("brick", 77e9)
    # 77 is nearer to 110 than to 40 in ratio
    assert permittivity("brick", 77e9, extrapolate=True).real == pytest.approx(4.15)


def test_names_are_forgiving_and_unknown_ones_listed() -> None:
    assert material_name("Very dry-ground") == "very_dry_ground"
    assert material_name("steel") == "metal"
    with pytest.raises(ValueError, match=r"unknown material 'cheese', known are vacuum, concrete"):
        material_name("cheese")


@pytest.mark.parametrize("frequency_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_frequencies_are_refused(frequency_hz: float) -> None:
    with pytest.raises(ValueError, match="frequency_hz must be finite and positive"):
        permittivity("glass", frequency_hz)


def test_asphalt_is_as_measured() -> None:
    """eps 5.0, tan 0.02: penetration lambda sqrt(eps') / (2 pi eps'') of 12..14 cm at 8 GHz, about 4 cm at 30 GHz."""
    for frequency_hz, least_m, most_m in ((8e9, 0.12, 0.14), (30e9, 0.03, 0.04)):
        medium = permittivity("asphalt", frequency_hz)
        depth_m = 299_792_458.0 / frequency_hz * math.sqrt(medium.real) / (2.0 * math.pi * -medium.imag)
        assert least_m <= depth_m <= most_m
    with pytest.raises(ValueError, match=r"asphalt is known for 7\.\.30 GHz, got 77 GHz"):
        permittivity("asphalt", 77e9)


def test_a_material_is_one_layer() -> None:
    assert wall_layers("concrete", 0.4, 10e9) == ((permittivity("concrete", 10e9), 0.4),)
    assert wall_layers("concrete", None, 10e9) == ((permittivity("concrete", 10e9), math.inf),)


def test_constructions_have_their_layers() -> None:
    glass = permittivity("glass", 77e9)
    assert wall_layers("Double glazing", None, 77e9) == ((glass, 4e-3), (1.0 + 0.0j, 16e-3), (glass, 4e-3))
    assert wall_layers("window", None, 77e9) == ((glass, 6e-3),)
    for name in CONSTRUCTIONS:
        for frequency_hz in (10e9, 77e9):
            assert all(medium.imag <= 0.0 for medium, _ in wall_layers(name, None, frequency_hz))


def test_a_window_is_a_pane_to_walls_and_glass_to_tables() -> None:
    assert wall_name("window") == "window"
    assert material_name("window") == "glass"


def test_walls_refuse_what_makes_no_sense() -> None:
    with pytest.raises(ValueError, match="double_glazing has the thicknesses of its layers"):
        wall_layers("double_glazing", 0.1, 10e9)
    for thickness_m in (0.0, -0.1, math.nan):
        with pytest.raises(ValueError, match="thickness_m must be positive"):
            wall_layers("concrete", thickness_m, 10e9)
    with pytest.raises(ValueError, match="vegetation is a volume"):
        wall_layers("hedge", None, 10e9)
    with pytest.raises(ValueError, match=r"unknown material 'cheese', known are .*asphalt, window.*vegetation"):
        wall_layers("cheese", None, 10e9)
    with pytest.raises(ValueError, match="brick is known for"):
        wall_layers("brick", 0.1, 77e9)


def test_extrapolation_is_said() -> None:
    assert wall_layers("brick", None, 77e9, extrapolate=True) == ((permittivity("brick", 77e9, True), math.inf),)
    assert extrapolation_note("brick", 77e9) == "extrapolated beyond 1..40 and 110..330 GHz"
    assert extrapolation_note("brick", 40e9) == ""
    # a construction is known where all its materials are
    assert validity_ghz("double_glazing") == ((0.1, 100.0),)
    assert extrapolation_note("double_glazing", 120e9) == "extrapolated beyond 0.1..100 GHz"


def test_only_foliage_is_a_volume() -> None:
    assert [name for name in wall_names() if is_volume(name)] == ["vegetation"]
    assert is_volume("hedge")


def test_usual_roughness_belongs_to_the_face() -> None:
    assert typical_roughness_mm("double_glazing") == typical_roughness_mm("glass") == (0.01, 0.05)
    assert typical_roughness_mm("wood") is None
    for name in wall_names():
        found = typical_roughness_mm(name)
        assert found is None or 0.0 < found[0] < found[1]
