"""One table names all effects: its rows, the bits of paths, the files of path effects and the switches agree."""

from __future__ import annotations

import pytest

from msgs.files.shipped import CHECKOUT
from sim_player.effects import weights
from sim_player.effects.table import ALL_EFFECTS, EFFECTS, PATHS, SIGNAL, WEIGHTS, check_effects
from sim_player.signal.switches import SignalEffects
from sim_player.trace.effect_names import PATH_EFFECTS, bit

FOLDER = CHECKOUT / "sim_player" / "effects"
#: Files that are no path effect.
SHARED = {"__init__", "names", "table", "weights"}


def test_one_file_a_path_effect() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} - SHARED == set(PATHS)


def test_table_names_the_effects_in_one_order() -> None:
    assert tuple(PATHS) == PATH_EFFECTS
    assert tuple(EFFECTS) == (*PATHS, *WEIGHTS, *SIGNAL)
    assert set(EFFECTS) == ALL_EFFECTS
    assert len(EFFECTS) == len(PATHS) + len(WEIGHTS) + len(SIGNAL)
    assert sorted(bit(name) for name in PATH_EFFECTS) == [1 << index for index in range(len(PATH_EFFECTS))]


def test_signal_effects_are_the_switches_of_the_signal() -> None:
    # range migration goes with motion
    assert set(SIGNAL) == set(SignalEffects.__struct_fields__) - {"range_migration"}


@pytest.mark.parametrize("name", PATHS)
def test_row_of_a_path_effect_holds_its_own_file(name: str) -> None:
    for function in (PATHS[name].absent, PATHS[name].apply):
        assert function.__module__ == f"sim_player.effects.{name}"


@pytest.mark.parametrize("name", WEIGHTS)
def test_row_of_a_weight_effect_holds_its_own_factor(name: str) -> None:
    assert WEIGHTS[name].apply is getattr(weights, name)


@pytest.mark.parametrize("name", EFFECTS)
def test_every_effect_has_its_parts(name: str) -> None:
    effect = EFFECTS[name]
    assert effect.about
    assert effect.cost_s >= 0.0
    assert callable(effect.absent)


def test_unknown_effects_are_refused_by_name() -> None:
    assert check_effects(frozenset({"squint", "adc"})) == {"squint", "adc"}
    with pytest.raises(ValueError, match="unknown magic, squit, known are adc, atmosphere"):
        check_effects(frozenset({"squit", "magic", "adc"}))
