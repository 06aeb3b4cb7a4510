"""Hard cases of confocal transients: nothing, a single photon, full counters, sizes that are none, a tail."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.special import ndtr

from lab.transients.light_cone import LightCone, reconstruct
from lab.transients.shape import hidden_shape
from models.physics.photons.flux import counts_between, pulses_of
from msgs.values.lidar import SpadParams
from tests.lab.transients.scans import scan_of
from tests.stability.catalogue import Errors

mp.dps = 60
MAX_COUNT = (1 << 32) - 1


def test_no_photon_at_all_is_said() -> None:
    scan = scan_of(np.zeros((8, 8, 64)))
    volume = reconstruct(scan, 0)
    assert not volume.any()
    with pytest.raises(ValueError, match="got a dark volume"):
        hidden_shape(volume, scan)


def test_a_single_photon_gives_a_finite_shape() -> None:
    counts = np.zeros((8, 8, 64))
    counts[3, 4, 40] = 1
    scan = scan_of(counts)
    shape = hidden_shape(reconstruct(scan, 0), scan)
    assert np.isfinite(shape.brightness).all()
    assert np.isfinite([*shape.plane, shape.distance_m, shape.tilt_rad]).all()
    assert 0.0 < shape.distance_m < scan.range_m[-1]


def test_full_counters_keep_their_shape() -> None:
    """Counts of 2^32 - 1 in place of 1: the same picture, as the transform is linear. Single precision."""
    rng = np.random.default_rng(0)
    some = rng.random((8, 8, 64)) < 0.2
    weak, full = (reconstruct(scan_of(some * level), 0) for level in (1, MAX_COUNT))
    assert np.isfinite(full).all()
    assert full / full.max() == pytest.approx(weak / weak.max(), abs=1e-4)
    flat = scan_of(np.full((8, 8, 64), MAX_COUNT))
    assert np.isfinite(hidden_shape(reconstruct(flat, 0), flat).distance_m)


@pytest.mark.parametrize("half_width_m", [0.0, -0.2, np.nan, np.inf, 1e30])
def test_widths_that_are_none(half_width_m: float) -> None:
    with pytest.raises(ValueError, match=r"half_width_m must lie in 0\.\.1000"):
        scan_of(np.zeros((8, 8, 64)), half_width_m=half_width_m)


@pytest.mark.parametrize("bin_s", [0.0, -1e-12, np.nan, np.inf, 1.0])
def test_bins_that_are_none(bin_s: float) -> None:
    with pytest.raises(ValueError, match="bin_s must lie in"):
        scan_of(np.zeros((8, 8, 64)), bin_s=bin_s)


@pytest.mark.parametrize("half_width_m", [1e-9, 1e3])
def test_a_square_far_smaller_or_larger_than_a_bin(half_width_m: float) -> None:
    """Cones that do not open, or leave every other pixel out of reach: finite, and the adjoint still fits."""
    rng = np.random.default_rng(0)
    cone = LightCone(scan_of(np.zeros((4, 4, 32)), half_width_m=half_width_m))
    volume, transients = rng.random((2, 4, 4, 32), np.float32)
    left, right = np.vdot(cone.forward(volume), transients), np.vdot(volume, cone.adjoint(transients))
    assert float(left) == pytest.approx(float(right), rel=1e-4)
    assert np.isfinite(cone.invert(transients)).all()


@pytest.mark.hard("models.physics.photons.flux", "exponential times distribution, both written out", 1e-9, "",
                  "tails cancel to their ratio, rms / delay = 1e-1 over z = 30, and rounding of z^2 / 2 = 450 in "
                  "each")  # fmt: skip
def test_ahead_of_a_pulse_with_a_tail(errors: Errors) -> None:
    """From 3 to 30 standard deviations ahead of a pulse all of whose photons come late. Relative error."""
    spad = SpadParams(tail_share=1.0, tail_s=0.86e-9, ambient_rate_hz=0.0)
    rms_s, ratio = mpf(spad.timing_rms_s), mpf(spad.timing_rms_s) / mpf(spad.tail_s)
    edges_s = 20e-9 - np.linspace(30.0, 3.0, 40) * spad.timing_rms_s
    z = [(mpf(float(edge)) - mpf(20e-9)) / rms_s for edge in edges_s]

    def until(at: mpf) -> mpf:
        return mp.ncdf(at) - mp.exp(ratio * ratio / 2 - ratio * at) * mp.ncdf(at - ratio)

    wanted = [until(later) - until(earlier) for earlier, later in pairwise(z)]

    plain_z, plain_ratio = (edges_s - 20e-9) / spad.timing_rms_s, float(ratio)
    naive = np.diff(
        1.0 - (1.0 - ndtr(plain_z)) - np.exp(plain_ratio**2 / 2 - plain_ratio * plain_z) * ndtr(plain_z - plain_ratio)
    )
    ours = counts_between(spad, pulses_of(spad, [20e-9], [1.0]), edges_s)

    def worst(found: np.ndarray) -> float:
        return max(float(abs(mpf(float(one)) / other - 1)) for one, other in zip(found, wanted, strict=True))

    errors(naive=worst(naive), ours=worst(ours))
