"""Backscatter of rain, snow and fog: Mie's series against a published value and its limits, laws at known amounts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.attenuation import fog_db_per_m, snow_db_per_m, water_permittivity
from models.physics.precipitation import mie_cross_section_m2, reflectivity_per_m


def test_mie_against_a_published_sphere_and_its_limits() -> None:
    """Bohren and Huffman, Appendix A: radius 0.525, wavelength 0.6328, index 1.55 has Q_back = 2.92534. A sphere of a
    hundredth of a wavelength: Rayleigh, to 1 %. Water of 10 wavelengths: its face's reflectance times pi a^2, to 1 dB.
    """
    published = mie_cross_section_m2(np.array([1.05]), 0.6328, 1.55**2 + 0j)[0]
    assert published / (math.pi * 0.525**2) == pytest.approx(2.92534, rel=1e-5)
    water = water_permittivity(77e9, 10.0)
    small = mie_cross_section_m2(np.array([0.01]), 1.0, water)[0]
    contrast = abs((water - 1.0) / (water + 2.0)) ** 2
    assert small == pytest.approx(math.pi**5 * contrast * 0.01**6, rel=0.01)
    large = mie_cross_section_m2(np.array([20.0]), 1.0, water)[0] / (math.pi * 100.0)
    face = abs((1.0 - np.sqrt(water)) / (1.0 + np.sqrt(water))) ** 2
    assert 10.0 * math.log10(large / face) == pytest.approx(0.0, abs=1.0)


def test_rain_at_both_bands() -> None:
    """10 GHz: Z = 200 R^1.6 and |K|^2 = 0.93, 25 mm/h give -49.15 dB 1/m. 77 GHz: a sum over drops apart, in steps of
    0.1 mm, to 0.1 dB; there Rayleigh's law is 9 dB too large at 5 mm/h and 19 dB at 50 mm/h.
    """
    assert 10.0 * math.log10(reflectivity_per_m(10e9, 25.0)) == pytest.approx(-49.153, abs=0.01)
    wavelength_m = 299792458.0 / 77e9
    diameter = np.arange(0.1, 10.0, 0.1)
    for rain, over_db in ((5.0, 9.2), (50.0, 18.7)):
        number = 8000.0 * np.exp(-4.1 * rain**-0.21 * diameter)
        one = mie_cross_section_m2(1e-3 * diameter, wavelength_m, water_permittivity(77e9, 10.0))
        got_db = 10.0 * math.log10(reflectivity_per_m(77e9, rain))
        assert got_db == pytest.approx(10.0 * math.log10(float(number @ one) * 0.1), abs=0.1)
        rayleigh = math.pi**5 * 0.93 * 200e-18 * rain**1.6 / wavelength_m**4
        assert 10.0 * math.log10(rayleigh) - got_db == pytest.approx(over_db, abs=0.1)


def test_snow_and_fog() -> None:
    """Snow of 1 mm/h: 0.224 x 1780 mm6/m3 at 10 GHz. Fog of 0.5 g/m3: 0.012 mm6/m3, and ITU-R P.840 loses 1.6 dB/km in
    it at 77 GHz and 10 deg C (figure 1 there); snow of 5 mm/h loses 2.0 dB/km by Skolnik's law.
    """
    per_z = math.pi**5 * 0.93e-18 / (299792458.0 / 10e9) ** 4
    assert reflectivity_per_m(10e9, snow_mm_per_h=1.0) == pytest.approx(0.224 * 1780.0 * per_z)
    assert reflectivity_per_m(10e9, fog_g_per_m3=0.5) == pytest.approx(0.012 * per_z)
    assert 1e3 * fog_db_per_m(77e9, 0.5, 10.0) == pytest.approx(1.6, abs=0.15)
    assert 1e3 * snow_db_per_m(77e9, 5.0) == pytest.approx(2.0, abs=0.05)
    # flakes as large as the wavelength send back less than Rayleigh's law says
    rayleigh = 0.224 * 1780.0 * 5.0**2.21 * per_z * 7.7**4
    assert 0.01 * rayleigh < reflectivity_per_m(77e9, snow_mm_per_h=5.0) < rayleigh


@pytest.mark.parametrize("amount", [-3.0, math.nan, 1e9])
@pytest.mark.parametrize("name", ["rain_mm_per_h", "snow_mm_per_h", "fog_g_per_m3"])
def test_no_other_amounts(name: str, amount: float) -> None:
    with pytest.raises(ValueError, match=f"{name} must lie in"):
        reflectivity_per_m(10e9, **{name: amount})
