"""Hard cases of optics: Eq. (14) as printed where its terms cancel, and smooth faces that scatter hardly anything."""

from __future__ import annotations

import numpy as np
import pytest
from mpmath import mp, mpf

from models.physics.fresnel import half_space_reflection
from models.physics.photons.optics import diffuse_reflectance, fresnel_power
from tests.stability.catalogue import Errors

EPS = 2.0**-52
mp.dps = 60


def printed_power(index: float, cosine: float) -> mpf:
    """|(TE + TM) / 2|^2 of Eqs. (13)-(14) in 60 digits."""
    c, n = mpf(cosine), mpf(index)
    inner = mp.sqrt(1 - (1 - c**2) / n**2)
    return (((c - n * inner) / (c + n * inner) + (n * c - inner) / (n * c + inner)) / 2) ** 2


@pytest.mark.hard(
    where="models.physics.photons.optics",
    naive="TE and TM added",
    bound=64 * EPS,
    unit="",
    source="a dozen roundings, twice by the square, and the digits of 1 + TE, a third of TE",
)
def test_printed_fresnel_power_near_normal_incidence(errors: Errors) -> None:
    """At 1e-4 rad TE and TM cancel to 1e-9 of themselves. Relative error of the power."""
    cosine = float(np.cos(1e-4))
    exact = printed_power(1.51, cosine)
    permittivity = np.complex128(1.51) ** 2
    added = half_space_reflection(permittivity, cosine) + half_space_reflection(permittivity, cosine, "tm")
    errors(
        naive=float(abs(mpf(float(np.abs(0.5 * added) ** 2)) / exact - 1)),
        ours=float(abs(mpf(float(fresnel_power(1.51, cosine, "printed"))) / exact - 1)),
    )


@pytest.mark.hard(
    where="models.physics.photons.optics",
    naive="1 - exp(-g^2)",
    bound=16 * EPS,
    unit="",
    source="roundings of the Fresnel power and of g^2",
)
def test_polished_face_scatters_a_little(errors: Errors) -> None:
    """Heights of 0.1 pm: what leaves the mirror is 2e-12 of it. Relative error of the scattered share."""
    roughness_m, wavelength_m = 1e-13, 850e-9
    phase = 4 * mp.pi * mpf(roughness_m) / mpf(wavelength_m)
    n = mpf(1.51)
    exact = ((n - 1) / (n + 1)) ** 2 * -mp.expm1(-(phase**2))
    g = 4.0 * np.pi * roughness_m / wavelength_m
    naive = (0.51 / 2.51) ** 2 * (1.0 - np.exp(-(g**2)))
    ours = float(diffuse_reflectance(1.51, 0.0, 1.0, roughness_m, wavelength_m))
    errors(naive=float(abs(mpf(float(naive)) / exact - 1)), ours=float(abs(mpf(ours) / exact - 1)))
