"""Hard cases of link budgets: hardly any light, false alarms once in a billion billion cells."""

from __future__ import annotations

import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.special import ndtri

from lab.compare.detection_snr import photon_snr
from models.physics.link_budget import spad_threshold
from msgs.values.lidar import SpadParams
from msgs.values.radar import RangeAzimuthGrid
from msgs.values.units import SPEED_OF_LIGHT_MPS
from tests.stability.catalogue import Errors

EPS = 2.0**-52
mp.dps = 60


@pytest.mark.hard("models.physics.link_budget", "counts with the echo less counts without", 100 * EPS, "",
                  "a dozen roundings; the exponent -rate t of the waiting pulses carries its own")  # fmt: skip
def test_an_echo_of_a_photon_in_a_billion_pulses(errors: Errors) -> None:
    """Diffuse light falls as L^-4: 1e-9 photons a pulse beside 0.04 of ambient. Relative error of the SNR."""
    spad, photons, range_m = SpadParams(arming="gated"), 1e-9, 8.0
    rate, half_s = spad.ambient_rate_hz, RangeAzimuthGrid().range_bin_m / SPEED_OF_LIGHT_MPS
    before_s = 2.0 * range_m / SPEED_OF_LIGHT_MPS - half_s
    h, waiting = mpf(rate) * mpf(half_s), spad.pulses * mp.exp(-mpf(rate) * mpf(before_s))
    excess, after = waiting * (mp.exp(-h) - mp.exp(-h - mpf(photons))), mp.exp(-h - mpf(photons))
    wanted = excess**2 / (waiting * (1 - mp.exp(-h)) * (1 + after))
    waits = spad.pulses * np.exp(-rate * before_s)
    at_echo, past = waits * np.exp(-rate * half_s), waits * np.exp(-rate * half_s - photons)
    naive = (at_echo - past) ** 2 / ((waits - at_echo) * (1.0 + past / waits))
    errors(
        naive=float(abs(mpf(float(naive)) / wanted - 1)),
        ours=float(abs(mpf(float(photon_snr(spad, range_m, photons))) / wanted - 1)),
    )


@pytest.mark.hard("models.physics.link_budget", "quantile of 1 - P_fa", 1e-13, "", "the quantile's own accuracy")
def test_a_false_alarm_in_a_billion_billion_cells(errors: Errors) -> None:
    """P_fa 1e-18: 1 - P_fa of doubles is one, its quantile infinite. Relative error of the threshold."""
    quantile = mp.sqrt(2) * mp.erfinv(1 - 2 * mpf(1e-18))
    wanted = quantile**2
    naive, ours = float(ndtri(1.0 - 1e-18)) ** 2, float(spad_threshold(1e-18))
    errors(naive=float(abs(mpf(naive) / wanted - 1)), ours=float(abs(mpf(ours) / wanted - 1)))
