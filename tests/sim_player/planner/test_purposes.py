"""Purposes by name, and the least reference of each law."""

from __future__ import annotations

import numpy as np
import pytest

from sim_player.planner.purposes import LEAST, Purpose, purpose_of


def test_names() -> None:
    assert [purpose_of(word) for word in ("samples", "peaks", "objects")] == list(Purpose)
    with pytest.raises(ValueError, match="purpose must be one of samples, peaks, objects, got 'maps'"):
        purpose_of("maps")


def test_least_references_over_the_noise() -> None:
    """The noise, the detector's threshold, and what changes by the noise at -20 dB."""
    assert [20.0 * np.log10(LEAST[purpose]) for purpose in Purpose] == pytest.approx([0.0, 13.0, 20.0])
