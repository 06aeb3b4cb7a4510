"""The detection stage's check of its input: a map with numbers that no power follows of reaches no detector."""

from __future__ import annotations

import numpy as np
import pytest

from models.perception.find.maps_to_peaks import MAX_AMPLITUDE, require_sound
from msgs.values.radar import RangeAzimuthMap
from tests.builders import example_map


def map_with(value: complex) -> RangeAzimuthMap:
    """A map of noise with one cell of its own."""
    values = np.full((512, 256), 1e-7, np.complex64)
    values[300, 100] = value
    return example_map(values, noise_power_mw=1e-14)


@pytest.mark.parametrize("turn", [1.0, 1.0j, -1.0, -1.0j])
def test_an_amplitude_is_limited_whatever_its_phase(turn: complex) -> None:
    """One cell at half and at twice the limit of 1e15; the sign of either part says nothing of the power."""
    require_sound(map_with(0.5 * MAX_AMPLITUDE * turn))
    with pytest.raises(ValueError, match=r"map\.values must be finite, of at most 1e\+15, got"):
        require_sound(map_with(2.0 * MAX_AMPLITUDE * turn))


@pytest.mark.parametrize("value", [complex(-np.inf, 0.0), complex(0.0, -np.inf), complex(np.nan, 0.0)])
def test_a_map_that_is_not_finite_is_refused(value: complex) -> None:
    with pytest.raises(ValueError, match=r"map\.values must be finite"):
        require_sound(map_with(value))
