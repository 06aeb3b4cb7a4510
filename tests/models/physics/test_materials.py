"""Permittivities of ITU-R P.2040 and the ranges they hold in."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable

import pytest

from models.physics.materials import (
    CONSTRUCTIONS,
    SAMPLE_SCATTER,
    TABLE,
    VACUUM_PERMITTIVITY_F_PER_M,
    band_note,
    is_volume,
    material_name,
    needs_extrapolation,
    permittivity,
    reflection_error_db,
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
    with pytest.raises(ValueError, match=r"brick is known for 1\.\.40 and 110\.\.330 GHz, got 400 GHz"):
        permittivity("brick", 400e9)
    assert permittivity("brick", 400e9, extrapolate=True).real == pytest.approx(4.15)


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
    with pytest.raises(ValueError, match="plywood is known for"):
        wall_layers("plywood", 0.1, 77e9)


def test_extrapolation_is_said() -> None:
    assert wall_layers("plywood", None, 77e9, extrapolate=True) == ((permittivity("plywood", 77e9, True), math.inf),)
    assert band_note("plywood", 77e9) == "extrapolated beyond 1..40 GHz"
    assert band_note("brick", 400e9) == "extrapolated beyond 1..40 and 110..330 GHz"
    assert band_note("brick", 40e9) == ""
    # a construction is known where all its materials are
    assert validity_ghz("double_glazing") == ((0.1, 100.0),)
    assert band_note("double_glazing", 120e9) == "extrapolated beyond 0.1..100 GHz"
    assert band_note("hedge", 200e9) == "extrapolated beyond 0.23..95 GHz"


def sigma_of(medium: complex, frequency_hz: float) -> float:
    return -medium.imag * 2.0 * math.pi * frequency_hz * VACUUM_PERMITTIVITY_F_PER_M


def test_brick_at_77_ghz_lies_between_its_bands() -> None:
    """By hand: 77 GHz lies at ln(77/40) / ln(110/40) = 0.6474 of the gap; eps' 3.91 and 4.15; sigma 0.0238 * 40^0.16 =
    0.04294 and 0.0006 * 110^1.5712 = 0.9675 S/m. So eps' 4.0637 and sigma 0.3226 S/m, without being asked twice."""
    medium = permittivity("brick", 77e9)
    assert medium.real == pytest.approx(4.0637, abs=1e-4)
    assert sigma_of(medium, 77e9) == pytest.approx(0.3226, abs=2e-4)
    assert permittivity("brick", 77e9, extrapolate=True) == medium
    assert wall_layers("brick", 0.24, 77e9) == ((medium, 0.24),)
    assert band_note("bricks", 77e9) == "interpolated between 40 and 110 GHz"
    assert not needs_extrapolation("brick", 77e9)


@pytest.mark.parametrize("name", ["concrete", "brick", "glass"])
def test_a_gap_is_continuous_at_both_ends_and_rises_or_falls_all_along(name: str) -> None:
    low, high = TABLE[name]
    edges_hz = (1e9 * low.max_ghz, 1e9 * high.min_ghz)
    for edge_hz, inward in zip(edges_hz, (1.0 + 1e-9, 1.0 - 1e-9), strict=True):
        assert band_note(name, edge_hz) == ""
        assert band_note(name, edge_hz * inward).startswith("interpolated between")
        assert permittivity(name, edge_hz * inward) == pytest.approx(permittivity(name, edge_hz), rel=1e-7)
    ratio = edges_hz[1] / edges_hz[0]
    frequencies_hz = [edges_hz[0] * ratio ** (step / 20) for step in range(21)]
    media = [permittivity(name, frequency_hz) for frequency_hz in frequencies_hz]
    sigmas = [sigma_of(*pair) for pair in zip(media, frequencies_hz, strict=True)]
    for values in ([medium.real for medium in media], sigmas):
        assert values in (sorted(values), sorted(values, reverse=True))


def test_rows_rise_in_frequency_and_leave_gaps() -> None:
    for rows in TABLE.values():
        edges = [edge for row in rows for edge in (row.min_ghz, row.max_ghz)]
        assert edges == sorted(set(edges))


def half_space_db(medium: complex) -> float:
    index = medium**0.5
    return 20.0 * math.log10(abs((index - 1.0) / (index + 1.0)))


def test_an_interpolated_reflection_states_what_the_rows_disagree_by() -> None:
    """The rows continued to 77 GHz: eps' 3.91, sigma 0.0238 * 77^0.16 = 0.0477 S/m (R -9.67 dB); eps' 4.15, 0.5523
    S/m (-9.33 dB). R is -9.45 dB, 0.23 dB from the farther one."""
    error_db = reflection_error_db("brick", 77e9)
    lossy = [
        complex(eps, -sigma / (2.0 * math.pi * 77e9 * VACUUM_PERMITTIVITY_F_PER_M))
        for eps, sigma in ((3.91, 0.0238 * 77.0**0.16), (4.15, 0.0006 * 77.0**1.5712))
    ]
    expected = max(abs(half_space_db(medium) - half_space_db(permittivity("brick", 77e9))) for medium in lossy)
    assert error_db == pytest.approx(expected, rel=1e-9)
    assert error_db == pytest.approx(0.23, abs=0.005)


def test_an_extrapolated_reflection_states_the_scatter_of_samples() -> None:
    """Asphalt's loss tangent is constant, so both continuations agree, and the scatter of samples decides: eps - 1 of 4
    divided by 1.3 gives eps' 4.077, R -9.43 dB against -8.36 dB. Wet ground: held at 10 GHz, 0.42 dB; scatter, 0.62."""
    assert reflection_error_db("asphalt", 77e9) == pytest.approx(
        half_space_db(5.0) - half_space_db(1.0 + 4.0 / 1.3), abs=1e-3
    )
    assert half_space_db(permittivity("very_dry_ground", 77e9, True)) - half_space_db(
        permittivity("very_dry_ground", 10e9)
    ) == pytest.approx(reflection_error_db("very_dry_ground", 77e9), rel=1e-9)  # the end of the band held
    assert reflection_error_db("floorboard", 10e9) == pytest.approx(1.25, abs=0.01)


def test_the_scatter_is_that_of_concrete_at_57_5_ghz() -> None:
    """Measured index 2.55 - j0.084: eps' 6.495; 5.495 / 4.24 = 1.296."""
    measured = complex(2.55, -0.084) ** 2
    assert abs(measured - 1.0) / abs(permittivity("concrete", 57.5e9) - 1.0) == pytest.approx(SAMPLE_SCATTER, abs=0.01)


def test_an_error_is_stated_outside_measured_bands_alone() -> None:
    for name in wall_names():
        for frequency_ghz in (5.0, 10.0, 40.0, 77.0, 105.0, 200.0):
            error_db = reflection_error_db(name, 1e9 * frequency_ghz)
            assert (error_db is None) == (is_volume(name) or not band_note(name, 1e9 * frequency_ghz))
            assert error_db is None or 0.0 <= error_db < 7.0
    # the worst layer counts: air has no error, glass between its bands has
    assert reflection_error_db("double_glazing", 120e9) == reflection_error_db("glass", 120e9)
    # nothing to differ by, and a conductor that mirrors whatever its conductivity
    assert reflection_error_db("vacuum", 120e9) == 0.0
    assert reflection_error_db("container", 120e9) == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("function", [permittivity, reflection_error_db])
def test_bad_questions_are_refused(function: Callable[[str, float], object]) -> None:
    with pytest.raises(ValueError, match="unknown material 'cheese', known are"):
        function("cheese", 77e9)
    for frequency_hz in (0.0, -77e9, math.nan, math.inf):
        with pytest.raises(ValueError, match="frequency_hz must be finite and positive"):
            function("brick", frequency_hz)


def test_only_foliage_is_a_volume() -> None:
    assert [name for name in wall_names() if is_volume(name)] == ["vegetation"]
    assert is_volume("hedge")


def test_usual_roughness_belongs_to_the_face() -> None:
    assert typical_roughness_mm("double_glazing") == typical_roughness_mm("glass") == (0.01, 0.05)
    assert typical_roughness_mm("wood") is None
    for name in wall_names():
        found = typical_roughness_mm(name)
        assert found is None or 0.0 < found[0] < found[1]
