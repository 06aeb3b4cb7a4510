"""The planner's law on random places and on scenes made to need one effect; reasons; bad questions."""

from __future__ import annotations

import functools
from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from models.physics.waveform import window_noise_gain
from msgs.values.radar import RadarSetup
from sim_player.dataset.labelled_scan import LABELS, label_points
from sim_player.effects.table import ALL_EFFECTS, SIGNAL, WEIGHTS
from sim_player.generate.places import random_place
from sim_player.paths.truth import hidden_objects
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import (
    Plan,
    clean_profiles,
    manual_plan,
    noisy_profiles,
    plan_world,
    planned_profiles,
    resolve_plan,
)
from sim_player.planner.purposes import Purpose
from sim_player.scene.description import Ego, Scene, SceneObject, SceneRadar, Surface, Weather
from sim_player.scene.front_end import FrontEnd, Spur
from sim_player.scene.world import prepare
from sim_player.signal.levels import hann_profiles, noise_density_mw, noise_profiles
from sim_player.trace.effect_names import PATH_EFFECTS
from tests.sim_player.planner.plans import plan_effects

WALL = Surface(
    role="relay", material="concrete", polyline_m=((20.0, -10.0), (20.0, 15.0)), height_m=6.0, thickness_mm=300
)
CAR = SceneObject(class_="car", x_m=12.0, y_m=6.0)


def scene(*parts: Surface | SceneObject, **more: object) -> Scene:
    return Scene(
        name="t",
        surfaces=tuple(part for part in parts if isinstance(part, Surface)),
        objects=tuple(part for part in parts if isinstance(part, SceneObject)),
        **more,  # type: ignore[arg-type]
    )


def used(plan: Plan, name: str) -> bool:
    return next(effect for effect in plan.effects if effect.name == name).used


def reason(plan: Plan, name: str) -> str:
    return next(effect for effect in plan.effects if effect.name == name).reason


def everything_of(asked: Scene, seed: int) -> tuple[Plan, np.ndarray, np.ndarray]:
    """All effects of a scene: their plan, its profiles with noise, and the rms of that; what plans are held against."""
    return _everything(msgspec.json.encode(asked), seed)


@functools.lru_cache(maxsize=4)
def _everything(content: bytes, seed: int) -> tuple[Plan, np.ndarray, np.ndarray]:
    asked = msgspec.json.decode(content, type=Scene)
    setup, front_end = asked.setup, asked.radar.front_end
    plan = manual_plan(prepare(asked, seed), setup)
    density = noise_density_mw(setup, np.arange(512), plan.signal, front_end)
    rms = np.sqrt(density * window_noise_gain("hann"))
    return plan, clean_profiles(plan, setup, seed) + noise_profiles(setup, seed, plan.signal, front_end), rms


def off(asked: Scene, plan: Plan, seed: int, profiles: Callable[..., np.ndarray] = planned_profiles) -> float:
    """The law's ratio in the plan's worst cell of beams and map, same noise."""
    setup, front_end = asked.setup, asked.radar.front_end
    _, wanted, rms = everything_of(asked, seed)
    found = profiles(plan, setup, seed) + noise_profiles(setup, seed, plan.signal, front_end)
    return float(cells_of(setup).off(wanted, found, rms, plan.purpose).max())


@pytest.mark.slow
@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("purpose", Purpose)
@pytest.mark.parametrize("budget_db", [-10.0, -30.0])
def test_the_laws_on_random_places(index: int, purpose: Purpose, budget_db: float) -> None:
    """All effects against the planned ones, same noise: no cell is off by more than the budget, nor than the bound.

    The paths that are left, and the profiles evaluated on the way.
    """
    asked = random_place(21, index)
    plan = plan_world(prepare(asked, index), asked.setup, budget_db, purpose=purpose, profiles_only=True)
    ratio = max(off(asked, plan, index, profiles) for profiles in (planned_profiles, clean_profiles))
    assert ratio <= 10.0 ** (budget_db / 20.0)
    assert plan.spent_db is not None
    assert plan.spent_db <= budget_db + 1e-9
    # float32 rounds at 1e-7 of the strongest, some -80 dB over noise
    assert ratio <= 10.0 ** (plan.spent_db / 20.0) + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("purpose", "correlation_mm"), [(Purpose.SAMPLES, 300.0), (Purpose.PEAKS, 5.0)])
def test_the_laws_with_kirchhoffs_lobe(purpose: Purpose, correlation_mm: float) -> None:
    """A narrow lobe, whose maximum towards the radar lies 10 dB over Lambert's, and a wide one: plans keep their law.

    Traced patches carry their lobe, so the evaluated bound holds it; what diffuse scattering alone changes is under it.
    """
    place = random_place(21, 1)
    surfaces = tuple(
        msgspec.structs.replace(surface, roughness_mm=2.0, correlation_mm=correlation_mm) for surface in place.surfaces
    )
    asked = msgspec.structs.replace(place, surfaces=surfaces)
    world = prepare(asked, 1)
    plan = plan_world(world, asked.setup, -20.0, thorough=True, purpose=purpose, profiles_only=True)
    ratio = max(off(asked, plan, 1, profiles) for profiles in (planned_profiles, clean_profiles))
    assert plan.spent_db is not None
    assert ratio <= 10.0 ** (plan.spent_db / 20.0) + 1e-3 <= 0.101
    if purpose is Purpose.SAMPLES:
        bound_db = next(effect.bound_db for effect in plan.effects if effect.name == "diffuse_scattering")
        without = manual_plan(world, asked.setup, ALL_EFFECTS - {"diffuse_scattering"})
        assert bound_db is not None
        assert 0.0 < off(asked, without, 1) <= 10.0 ** (bound_db / 20.0) + 1e-3


@pytest.mark.slow
def test_profiles_are_evaluated_on_the_way() -> None:
    """Asked for profiles only, a plan evaluates what it keeps within its law and its own bound.

    Unbalanced I and Q, leakage and spurs are in them. At -60 dB single precision is not enough, and none are given.
    """
    place, purpose = random_place(21, 0), Purpose.OBJECTS
    faults = FrontEnd(
        iq_gain_db=0.5, iq_phase_deg=3.0, leakage_dbm=-45.0, spurs=(Spur(frequency_hz=2e7, power_dbm=-95.0),)
    )
    radar = msgspec.structs.replace(place.radar, front_end=faults)
    for asked in (place, msgspec.structs.replace(place, radar=radar)):
        plan = plan_world(prepare(asked, 0), asked.setup, purpose=purpose, profiles_only=True)
        assert plan.evaluated is not None or asked is not place
        assert plan.spent_db is not None
        assert 0.0 < off(asked, plan, 0, clean_profiles) <= 10.0 ** (plan.spent_db / 20.0) <= 0.1
    assert plan_world(prepare(place, 0), place.setup, -60.0, purpose=purpose, profiles_only=True).evaluated is None


@pytest.mark.slow
@pytest.mark.parametrize("purpose", Purpose)
def test_beats_of_the_strongest_alone_are_double(purpose: Purpose) -> None:
    """The beats of a place, most of its echoes in single precision, keep the law and the plan's own bound."""
    asked = random_place(21, 0)
    plan = plan_world(prepare(asked, 0), asked.setup, purpose=purpose)
    assert plan.spent_db is not None
    assert 0.5 * len(plan.single) < plan.single.sum() < len(plan.single)

    def profiles(plan: Plan, setup: RadarSetup, seed: int) -> np.ndarray:
        return hann_profiles(plan.beats(), setup.radar.samples_per_chirp)

    assert off(asked, plan, 0, profiles) <= 10.0 ** (plan.spent_db / 20.0) + 1e-3 <= 0.101


@pytest.mark.slow
def test_a_wider_budget_never_needs_more_paths() -> None:
    asked = random_place(21, 0)
    world = prepare(asked, 0)
    kept = [len(plan_world(world, asked.setup, b).echoes) for b in (-40.0, -30.0, -20.0, -10.0)]
    assert kept == sorted(kept, reverse=True)
    assert kept[-1] < kept[0]


def test_absent_effects_say_why() -> None:
    plan = plan_effects(scene(CAR))
    for name, why in {
        "specular_relay": "no wall",
        "second_relay": "0 walls",
        "ground_bounce": "no ground",
        "object_interreflection": "1 object",
        "motion": "nothing moves",
        "mutual_coupling": "do not couple",
        "flicker": "no 1/f noise",
        "leakage": "no leakage",
        "spurs": "no spurs",
        "curved_wall": "straight",
    }.items():
        assert not used(plan, name)
        assert why in reason(plan, name)
    assert used(plan, "los_objects")
    assert used(plan, "thermal_noise")


def test_present_effects_are_called_for() -> None:
    """Strong enough by far: a car in a mirror over wet asphalt, faults of the front end, motion."""
    faults = FrontEnd(
        coupling_db=-20.0, flicker_corner_hz=1e6, leakage_dbm=-40.0, spurs=(Spur(frequency_hz=2e7, power_dbm=-70.0),)
    )
    ground = Surface(role="ground", material="asphalt")
    asked = scene(WALL, CAR, ground, radar=SceneRadar(front_end=faults), ego=Ego(speed_mps=3.0))
    plan = plan_effects(asked)
    for name in (
        "specular_relay",
        "ground_bounce",
        "mutual_coupling",
        "flicker",
        "leakage",
        "spurs",
        "motion",
        "non_cofocal",
    ):
        assert used(plan, name), reason(plan, name)


def test_opaque_walls_transmit_nothing_that_matters() -> None:
    """A car behind 40 cm of concrete: two-way -162 dB under what stood free; glass instead calls for it."""
    behind = SceneObject(class_="car", x_m=28.0, y_m=0.0)
    thick = msgspec.structs.replace(WALL, thickness_mm=400.0)
    pane = msgspec.structs.replace(WALL, material="glass", thickness_mm=6.0)
    assert not used(plan_effects(scene(thick, behind)), "wall_transmission")
    assert used(plan_effects(scene(pane, behind)), "wall_transmission")


def test_weather_matters_only_when_it_rains() -> None:
    """A pedestrian 13 m away in dry air loses 4e-4 dB, 5e-5 of the field, 40 dB over the noise: under a wide budget."""
    walker = SceneObject(class_="pedestrian", x_m=12.0, y_m=6.0)
    dry, wet = scene(walker), scene(walker, weather=Weather(rain_mm_per_h=150.0))
    for asked in (dry, wet):
        plan = plan_world(prepare(asked), asked.setup, -0.5, purpose=Purpose.OBJECTS)
        assert used(plan, "atmosphere") == (asked is wet)


def test_separated_arrays_are_kept() -> None:
    """0.2 m between transmitter and receiver turns near echoes by a good part of a turn: more than any budget."""
    asked = scene(CAR, radar=SceneRadar(separation_m=0.2))
    plan = plan_effects(asked)
    assert used(plan, "non_cofocal")
    assert off(asked, plan, 0) <= 0.1


def test_an_empty_view_is_noise_not_an_error() -> None:
    """A car behind the radar returns nothing: the plan holds no path and the map is noise."""
    asked = scene(SceneObject(class_="car", x_m=-30.0, y_m=0.0))
    plan = plan_effects(asked)
    assert plan.single.all()
    profiles = noisy_profiles(plan, asked.setup, seed=1)
    assert profiles.shape == (25, 512)
    rms = np.sqrt(np.mean(np.abs(profiles) ** 2))
    density = noise_density_mw(asked.setup, np.arange(512), plan.signal)
    np.testing.assert_allclose(rms, np.sqrt(density[0] * 1.5), rtol=0.02)


def test_moving_scenes_leave_out_only_what_they_have_nothing_of() -> None:
    """One instant says nothing of the next: a weak effect stays, one without a cause goes at any time."""
    moves = plan_effects(scene(WALL, msgspec.structs.replace(CAR, speed_mps=5.0)))
    assert {effect.bound_db for effect in moves.effects} == {None}
    assert used(moves, "atmosphere")
    assert "the scene moves" in reason(moves, "atmosphere")
    assert not used(moves, "curved_wall")
    assert len(moves.echoes) == moves.traced
    assert sum(effect.cost_s for effect in moves.effects) == pytest.approx((6e-6 + 30e-6 + 60e-6) * moves.traced)


def test_peaks_need_less_than_samples_and_objects_less_than_peaks() -> None:
    asked = random_place(21, 0)
    world = prepare(asked, 0)
    kept = [len(plan_world(world, asked.setup, purpose=purpose).echoes) for purpose in Purpose]
    assert kept[2] < kept[1] < kept[0]


@pytest.mark.parametrize("index", range(3))
def test_labels_are_those_of_all_effects(index: int) -> None:
    """Truth points of places as planned for objects, at a wide budget: the same numbers as of all. And its costs."""
    asked = random_place(21, index)
    world = prepare(asked, index)
    everything = manual_plan(world, asked.setup)
    plan = plan_world(world, asked.setup, -3.0, purpose=Purpose.OBJECTS)
    assert len(plan.echoes) < 0.9 * len(everything.echoes)
    wanted, found = (label_points(asked.setup, one.labelled) for one in (everything, plan))
    for name in LABELS:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
    assert hidden_objects(plan.labelled) == hidden_objects(everything.labelled)
    # a path costs once, at the last effect that it needs; what is left and what is saved come to what was traced
    cost_s = {effect.name: effect.cost_s for effect in plan.effects}
    last = np.bincount(np.log2(plan.echoes.needs).astype(int), minlength=len(PATH_EFFECTS))
    np.testing.assert_allclose([cost_s[name] for name in PATH_EFFECTS], 6e-6 * last)
    whole_s = (6e-6 + 30e-6 + 60e-6) * len(everything.echoes)
    assert sum(cost_s.values()) + plan.saved_s == pytest.approx(whole_s)
    assert sum(map(plan.share_of, plan.effects)) == pytest.approx(100.0 * sum(cost_s.values()) / whole_s)


def test_bounds_change_no_decision() -> None:
    """What is shown is what runs: a thorough plan adds bounds alone, one for profiles a map alone."""
    asked = random_place(21, 1)
    world = prepare(asked, 1)
    shown, run, made = (
        plan_world(world, asked.setup, thorough=thorough, purpose=Purpose.OBJECTS, profiles_only=profiles_only)
        for thorough, profiles_only in ((True, False), (False, False), (False, True))
    )
    for plan in (run, made):
        bare = tuple(msgspec.structs.replace(effect, bound_db=None) for effect in shown.effects)
        assert plan.effects == bare
        np.testing.assert_array_equal(plan.echoes.chain, shown.echoes.chain)
        np.testing.assert_array_equal(plan.squints, shown.squints)
        np.testing.assert_array_equal(plan.overlaps, shown.overlaps)


def test_choices_by_word() -> None:
    asked = scene(WALL, CAR)
    world = prepare(asked)
    assert resolve_plan(world, asked.setup, "basic") is None
    everything = resolve_plan(world, asked.setup, "all")
    assert everything is not None
    assert {effect.name for effect in everything.effects} == set(ALL_EFFECTS)
    some = resolve_plan(world, asked.setup, "los_objects, thermal_noise")
    assert some is not None
    assert some.used == {"los_objects", "thermal_noise"}
    assert {*PATH_EFFECTS, *WEIGHTS, *SIGNAL} == ALL_EFFECTS


@pytest.mark.parametrize("bad", ["", " , ", "magic", "los_objects,magic"])
def test_unknown_effects_are_refused(bad: str) -> None:
    asked = scene(CAR)
    with pytest.raises(ValueError, match="effects: "):
        resolve_plan(prepare(asked), asked.setup, bad)


@pytest.mark.parametrize("bad", [0.0, 3.0, float("nan"), float("-inf")])
def test_budgets_are_negative(bad: float) -> None:
    with pytest.raises(ValueError, match="budget_db must be finite and negative"):
        plan_effects(scene(CAR), budget_db=bad)
