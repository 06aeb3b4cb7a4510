"""What a single-photon LiDAR may be: nothing negative, nothing without bounds, each refused by its name in a line."""

from __future__ import annotations

import math

import pytest

from msgs.values.lidar import MAX_PULSES, SPAD_LIMITS, LidarSetup, SpadParams


def test_every_number_has_limits_that_hold_table_2() -> None:
    numbers = {name for name in SpadParams.__struct_fields__ if not isinstance(getattr(SpadParams(), name), str)}
    assert set(SPAD_LIMITS) == numbers
    assert all(least >= 0.0 and math.isfinite(most) for least, most in SPAD_LIMITS.values())


@pytest.mark.parametrize("name", sorted(name for name, (least, _) in SPAD_LIMITS.items() if least > 0.0))
def test_nothing_is_refused_where_nothing_can_be_measured(name: str) -> None:
    with pytest.raises(ValueError, match=rf"^spad\.{name} must lie in .*, got 0"):
        SpadParams(**{name: 0})


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"measurement_time_s": 1e-9}, "spad.measurement_time_s must last 1 to 4294967295 periods of 6.66667e-08 s"),
        ({"measurement_time_s": 300.0}, "spad.measurement_time_s must last 1 to 4294967295 periods .* got 300.0"),
        ({"irf_fwhm_s": 1e-18, "jitter_rms_s": 0.0, "repetition_rate_hz": 1e3}, "spad.irf_fwhm_s must be longer or"),
        ({"tick_s": 1e-30}, "spad.tick_s must be 0 or at least a share of 1e-12 of the period"),
        ({"tick_s": 1e-6}, "spad.tick_s must not exceed the period"),
        ({"arming": "Gated"}, "spad.arming must be 'free' or 'gated', got 'Gated'"),
        ({"tick_from": "start"}, "spad.tick_from must be 'pulse' or 'run', got 'start'"),
        ({"gates": 2}, "spad.gates must be 1 unless spad.arming is 'gated', got 2"),
        ({"gates": 513, "arming": "gated"}, "spad.gates must not exceed the 450000 pulses or the 512 bins, got 513"),
    ],
)
def test_parameters_that_do_not_go_together_are_refused(changes: dict, rule: str) -> None:
    with pytest.raises(ValueError, match=f"^{rule}"):
        SpadParams(**changes)


def test_counts_of_the_longest_measurement_fit_32_bits() -> None:
    assert SpadParams(measurement_time_s=286.3).pulses <= MAX_PULSES == 2**32 - 1


@pytest.mark.parametrize("scan_period_s", [7.0, math.nan, math.inf, 1e300])
def test_a_scan_is_as_long_as_its_measurements_and_ends(scan_period_s: float) -> None:
    """256 measurements of 0.03 s."""
    with pytest.raises(ValueError, match=r"lidar\.scan_period_s must be no shorter than 256 measurements, 7.68 s"):
        LidarSetup(scan_period_s=scan_period_s)
