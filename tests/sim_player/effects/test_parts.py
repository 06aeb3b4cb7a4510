"""Every effect is one file with the same parts, and the tables of names agree with them."""

from __future__ import annotations

import pytest

from msgs.files.shipped import CHECKOUT
from sim_player.effects import EFFECTS, PATHS, WEIGHTS
from sim_player.effects.names import ALL_EFFECTS, PATH_EFFECTS, SIGNAL_EFFECTS, WEIGHT_EFFECTS, bit
from sim_player.signal.switches import SignalEffects

FOLDER = CHECKOUT / "sim_player" / "effects"
SHARED = {"__init__", "tracing", "noise_bounds"}


def test_one_file_an_effect() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} - SHARED == set(EFFECTS) == set(ALL_EFFECTS)


def test_tables_name_the_effects_in_one_order() -> None:
    assert tuple(PATHS) == PATH_EFFECTS
    assert tuple(WEIGHTS) == WEIGHT_EFFECTS
    assert tuple(EFFECTS) == PATH_EFFECTS + WEIGHT_EFFECTS + SIGNAL_EFFECTS
    assert set(SIGNAL_EFFECTS) <= set(SignalEffects.__struct_fields__)
    assert sorted(bit(name) for name in PATH_EFFECTS) == [1 << index for index in range(len(PATH_EFFECTS))]


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_has_its_parts(name: str) -> None:
    effect = EFFECTS[name]
    assert name == effect.NAME
    assert effect.ABOUT
    assert effect.COST_S >= 0.0
    assert callable(effect.absent)
    assert callable(effect.change)
