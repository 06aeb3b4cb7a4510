"""Air, rain and foliage against the figures their recommendations publish."""

from __future__ import annotations

import numpy as np
import pytest

from models.physics.attenuation import gas_db_per_m, rain_db_per_m, vegetation_db

#: The vapour's own pressure at 7.5 g/m3 and 15 deg C.
VAPOUR_HPA = 7.5 * 288.15 / 216.7


@pytest.mark.parametrize(
    ("frequency_ghz", "oxygen_db_per_km", "water_db_per_km"),
    [
        (12.0, 0.00869826406877357, 0.00953538822024593),
        (20.0, 0.0118835504778076, 0.0970473048151117),
        (60.0, 14.6234747964861, 0.154841840636247),
        (90.0, 0.0388697110724235, 0.341973394422181),
        (130.0, 0.0415090835995228, 0.751844703646129),
    ],
)
def test_air_agrees_with_the_validation_examples(
    frequency_ghz: float, oxygen_db_per_km: float, water_db_per_km: float
) -> None:
    """ITU-R's examples for P.676-13: 1013.25 hPa of DRY air, 15 deg C, 7.5 g/m3. Tolerance: rounding."""
    found = 1e3 * gas_db_per_m(frequency_ghz * 1e9, 15.0, 1013.25 + VAPOUR_HPA, 7.5)
    assert found == pytest.approx(oxygen_db_per_km + water_db_per_km, rel=1e-10)


def test_air_at_both_bands() -> None:
    """About 0.014 dB/km at 10 GHz and 0.34 dB/km at 77 GHz at sea level."""
    assert 1e3 * gas_db_per_m(10e9) == pytest.approx(0.0140, abs=5e-4)
    assert 1e3 * gas_db_per_m(77e9) == pytest.approx(0.344, abs=5e-3)


def test_moist_air_takes_more() -> None:
    for frequency_hz in (10e9, 77e9):
        levels = [gas_db_per_m(frequency_hz, 25.0, 1013.25, vapour) for vapour in (0.0, 5.0, 10.0, 20.0)]
        assert levels == sorted(levels)
        assert levels[0] > 0.0


@pytest.mark.parametrize(
    ("frequency_ghz", "k", "alpha"),
    [
        (10.0, 0.01129, 1.2156),
        (60.0, 0.8515, 0.7486),
        (76.0, 1.1139, 0.7091),
    ],
)
def test_rain_agrees_with_the_published_table(frequency_ghz: float, k: float, alpha: float) -> None:
    """P.838-3, Table 5 (printed to 4 figures): k is the loss in 1 mm/h [dB/km], alpha its slope over a decade."""
    one, ten = (1e3 * rain_db_per_m(frequency_ghz * 1e9, rain) for rain in (1.0, 10.0))
    assert one == pytest.approx(k, rel=5e-4)
    assert np.log10(ten / one) == pytest.approx(alpha, abs=6e-5)


def test_rain_is_that_of_vertical_polarisation() -> None:
    """25 mm/h at 10 GHz by Table 5: 0.01129 * 25^1.2156 = 0.5650 dB/km. Tolerance: four printed figures, 1e-3."""
    assert 1e3 * rain_db_per_m(10e9, 25.0) == pytest.approx(0.5650, rel=1e-3)


def test_no_rain_takes_nothing() -> None:
    assert rain_db_per_m(77e9, 0.0) == 0.0


def test_foliage_has_its_slope_and_its_end() -> None:
    """gamma d for thin hedges (0.45 f^0.284: 0.865 dB/m at 10 GHz, 1.545 at 77 GHz), never more than Am."""
    for frequency_hz, slope, most in ((10e9, 0.8654, 38.5), (77e9, 1.5453, 68.7)):
        assert vegetation_db(frequency_hz, 1e-4) == pytest.approx(1e-4 * slope, rel=1e-3)
        level = vegetation_db(frequency_hz, np.linspace(0.0, 100.0, 101))
        assert level[0] == 0.0
        assert np.all(np.diff(level) > 0.0)
        assert level[-1] < most
        # the longest wood takes no more
        assert vegetation_db(frequency_hz, 1e4) == pytest.approx(most, rel=2e-3)


def test_foliage_follows_weissberger() -> None:
    """0.45 f^0.284 d up to 14 m, 1.33 f^0.284 d^0.588 beyond; the one curve keeps within 15 % of the two."""
    depth_m = np.linspace(0.1, 100.0, 500)
    law = 10.0**0.284 * np.where(depth_m <= 14.0, 0.45 * depth_m, 1.33 * depth_m**0.588)
    assert np.abs(vegetation_db(10e9, depth_m) / law - 1.0).max() < 0.15


def test_values_beyond_validity_are_refused() -> None:
    with pytest.raises(ValueError, match=r"frequency_hz must lie in 1e\+09\.\.1e\+12, got 0\.5"):
        gas_db_per_m(0.5)
    with pytest.raises(ValueError, match=r"temperature_c must lie in -60\.\.60, got 288"):
        gas_db_per_m(10e9, 288.15)
    with pytest.raises(ValueError, match=r"pressure_hpa must lie in 300\.\.1100, got 101325"):
        gas_db_per_m(10e9, 15.0, 101325.0)
    with pytest.raises(ValueError, match=r"water_vapour_g_per_m3 must lie in 0\.\.100"):
        gas_db_per_m(10e9, 15.0, 1013.25, -1.0)
    with pytest.raises(ValueError, match=r"rain_mm_per_h must lie in 0\.\.300, got nan"):
        rain_db_per_m(10e9, float("nan"))
    with pytest.raises(ValueError, match=r"depth_m must not be negative, got .*nan"):
        vegetation_db(10e9, np.array([1.0, np.nan]))
    with pytest.raises(ValueError, match=r"frequency_hz must lie in 2\.3e\+08\.\.9\.5e\+10"):
        vegetation_db(100e9, 1.0)
