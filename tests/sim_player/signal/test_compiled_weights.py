"""Compiled weights of echoes: their series against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.signal.compiled_weights import _write_term


@pytest.mark.parametrize("powers", range(1, 10))
def test_series_of_any_length(powers: int) -> None:
    """A factor times a Chebyshev series, whatever is left of its powers after fours; in single precision: 1e-6."""
    rng = np.random.default_rng(powers)
    series = rng.standard_normal(powers) + 1j * rng.standard_normal(powers)
    place, factor = rng.uniform(-1.0, 1.0, 50), rng.standard_normal(50) + 1j * rng.standard_normal(50)
    out = np.empty((2, 50), np.float32)
    _write_term(out[0], out[1], factor.real.copy(), factor.imag.copy(), series, place, np.empty((4, 64)))
    wanted = factor * np.polynomial.chebyshev.chebval(place, series)
    np.testing.assert_allclose(out[0] + 1j * out[1], wanted, rtol=0.0, atol=1e-6 * np.abs(series).sum() * 3.0)
