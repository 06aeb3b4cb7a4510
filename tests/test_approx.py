"""Comparisons of small numbers: a relative tolerance is the one that counts."""

from __future__ import annotations

import pytest


def test_a_tolerance_that_would_be_swallowed_is_refused() -> None:
    """1e-13 is within pytest's default 1e-12 of 2e-13; asked for 1 % of it, the two must differ."""
    with pytest.raises(ValueError, match=r"approx\(1e-13, rel=0\.01\) needs abs=0\.0"):
        assert pytest.approx(1e-13, rel=0.01) == 2e-13
    assert pytest.approx(1e-13, rel=0.01, abs=0.0) != 2e-13
    assert pytest.approx(1e-13, rel=0.02, abs=0.0) == 1.01e-13


def test_other_comparisons_are_pytests_own() -> None:
    assert pytest.approx(0.0, rel=1e-6) == 1e-13
    assert pytest.approx([1.0, 2.0], rel=1e-6) == [1.0, 2.0 + 1e-6]
    assert pytest.approx(1.0) == 1.0 + 1e-7
