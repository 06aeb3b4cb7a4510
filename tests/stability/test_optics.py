"""Hard case of optics: smooth faces that scatter hardly anything."""

from __future__ import annotations

import numpy as np
import pytest
from mpmath import mp, mpf

from models.physics.photons.optics import diffuse_reflectance
from tests.stability.catalogue import Errors

EPS = 2.0**-52
mp.dps = 60


@pytest.mark.hard("models.physics.photons.optics", "1 - exp(-g^2)", 16 * EPS, "",
                  "roundings of the Fresnel power and of g^2")  # fmt: skip
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
