"""Permittivities of ITU-R P.2040 and the ranges they hold in."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from models.physics.materials import TABLE, VACUUM_PERMITTIVITY_F_PER_M, material_name, permittivity

SHARED_TABLE = Path(__file__).parents[2].parent / "shared" / "data" / "itu_p2040" / "itu_p2040_table3.csv"


def test_concrete_at_10_ghz() -> None:
    """eps 5.24, sigma 0.280 S/m, loss tangent 0.096 (printed to 3 figures)."""
    concrete = permittivity("concrete", 10e9)
    assert concrete.real == pytest.approx(5.24)
    assert -concrete.imag / concrete.real == pytest.approx(0.09598, rel=1e-3)


@pytest.mark.skipif(not SHARED_TABLE.exists(), reason="itu_p2040_table3.csv is not here")
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
            for frequency_ghz in (row.least_ghz, row.most_ghz):
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
    with pytest.raises(ValueError, match="unknown material 'cheese', known are vacuum, concrete"):
        material_name("cheese")


@pytest.mark.parametrize("frequency_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_frequencies_are_refused(frequency_hz: float) -> None:
    with pytest.raises(ValueError, match="frequency_hz must be finite and positive"):
        permittivity("glass", frequency_hz)
