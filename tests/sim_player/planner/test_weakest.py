"""Paths left out of moving scenes: the law in every cell, its parts, reasons, and what is kept whole."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from models.perception.form.slow_time_sums import group_edges
from sim_player.generate.places import random_place
from sim_player.paths.path_tracks import PathTrack, scene_step_s
from sim_player.paths.ray_tracing import trace
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import MOVES, ROUNDS, WEAKEST, Plan, plan_world
from sim_player.planner.purposes import Purpose
from sim_player.planner.weakest import FEWEST, REACH, SQUINTED, Weakest
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, SceneRadar, Surface
from sim_player.scene.front_end import FrontEnd
from sim_player.scene.world import World, prepare
from sim_player.signal.levels import RANGE_BINS
from sim_player.signal.slow_time_profiles import group_profiles
from sim_player.signal.swept_echoes import swept_echoes
from sim_player.trace.path_table import Paths
from tests.sim_player.planner.moving import left_out, reference

WALL = Surface(
    role="relay", material="concrete", polyline_m=((20.0, -10.0), (20.0, 15.0)), height_m=6.0, thickness_mm=300
)
CAR = SceneObject(class_="car", x_m=12.0, y_m=6.0, speed_mps=5.0)
#: A budget of nearly everything.
WIDE_DB = -0.01


def scene(*parts: Surface | SceneObject, **more: object) -> Scene:
    return Scene(
        name="t",
        surfaces=tuple(part for part in parts if isinstance(part, Surface)),
        objects=tuple(part for part in parts if isinstance(part, SceneObject)),
        **more,  # type: ignore[arg-type]
    )


def moving_place(index: int) -> World:
    """A random place whose road users and radar move, each by its own speed; the radar turns."""
    place, rng = random_place(29, index), np.random.default_rng(index)
    users = tuple(msgspec.structs.replace(user, speed_mps=float(rng.uniform(1.0, 15.0))) for user in place.objects)
    ego = Ego(speed_mps=float(rng.uniform(0.5, 8.0)), yaw_rate_dps=float(rng.uniform(-20.0, 20.0)))
    return prepare(msgspec.structs.replace(place, objects=users, ego=ego), index)


def planned(world: World, purpose: Purpose = Purpose.PEAKS, budget_db: float = -20.0) -> Plan:
    return plan_world(world, world.setup, budget_db, purpose=purpose)


def selection(plan: Plan) -> Weakest:
    assert plan.weakest is not None
    return plan.weakest


def paths_at(plan: Plan, time_s: float = 0.0) -> Paths:
    return trace(plan.view.world, time_s, plan.used)


@pytest.mark.slow
@pytest.mark.parametrize(("purpose", "index"), [*zip(Purpose, range(3), strict=True)])
def test_the_law_holds_in_every_cell_of_a_scan(purpose: Purpose, index: int) -> None:
    """Beams and map of one scan, each beam of its own time: what is left out stays under the budget, and is some of
    what there is. A budget ten times as wide breaks the law, so the test can fail.
    """
    world = moving_place(index)
    off, step_s = {}, scene_step_s(world)
    for budget_db in (-20.0, WIDE_DB):
        plan = planned(world, purpose, budget_db)
        track, beams = PathTrack(lambda at_s, plan=plan: paths_at(plan, at_s), step_s), range(len(plan.setup.beams))  # type: ignore[misc]
        times = [1e-9 * beam * plan.setup.beam_interval_ns for beam in beams]
        kept = [selection(plan).selected(track.at(times[beam]), beam)[0].mean() for beam in beams]
        left = np.stack([left_out(plan, track.at(times[beam]), beam) for beam in beams], axis=1)
        cells = cells_of(plan.setup)
        off[budget_db] = max(float((np.abs(cells.values(one)) / reference(plan)).max()) for one in left)
        assert np.mean(kept) < 0.9
    assert off[-20.0] <= 0.1
    assert 0.1 < off[WIDE_DB] <= 1.0


def test_a_beam_is_what_its_choice_leaves() -> None:
    """The player's terms of a beam against everything: the difference keeps the law."""
    world = moving_place(0)
    players = [ScenePlayer(world.scene, effects=word, purpose="peaks", precision="float64") for word in ("auto", "all")]
    plan = players[0].plan
    assert plan is not None
    edges = group_edges(plan.setup.radar.chirps_per_beam, 8)
    front_end = world.scene.radar.front_end
    for beam in (6, 12, 17):
        less, whole = (
            np.fft.fft(group_profiles(plan.setup, one.echoes(0, beam), edges, plan.signal, front_end), axis=0)
            for one in players
        )
        assert 0.0 < (np.abs(whole - less) / reference(plan)[beam]).max() <= 0.1


@pytest.mark.parametrize("index", range(2))
def test_fields_stay_under_their_bound_and_not_far_under_it(index: int) -> None:
    """Every path in every beam at every instant of the sweep; the best beams come near."""
    plan = planned(moving_place(index))
    paths, beams = paths_at(plan), range(len(plan.setup.beams))
    bound = np.stack([selection(plan).bounds(paths, beam) for beam in beams], axis=1)
    swept = swept_echoes(plan.setup, paths, plan.signal, plan.view.world.scene.radar.front_end, precision="float64")
    field = np.abs(swept.weights).max(axis=0).T
    assert (field <= bound * (1.0 + 1e-5)).all()
    strong = bound.max(axis=1) > np.median(bound.max(axis=1))
    assert np.median(field.max(axis=1)[strong] / bound.max(axis=1)[strong]) > 0.8


def test_tones_stay_between_the_bins_that_they_visit() -> None:
    """From a beam's first chirp to its last, Doppler included."""
    plan = planned(moving_place(0))
    radar, paths = plan.setup.radar, paths_at(plan)
    _, low, high, *_ = selection(plan)._asked(paths, 12)
    doppler = 2.0 * radar.chirp_period_s / radar.wavelength_m * paths.radial_speed_mps
    for share in (-0.5, 0.0, 0.5):
        range_m = 0.5 * paths.length_m + share * radar.beam_duration_s * paths.radial_speed_mps
        for turn in (-doppler, doppler):
            tone = range_m / radar.range_bin_m + turn
            on_map = tone < RANGE_BINS
            assert (np.abs(tone - np.clip(tone, low, high))[on_map] <= 0.5).all()
    assert np.median(high - low) <= 2


def test_skirts_of_squinting_echoes() -> None:
    """A beam's echo across its pattern, nulls and all: over its strongest instant no more than the skirts allow."""
    plan = planned(prepare(scene(WALL, CAR)))
    setup, radar = plan.setup, plan.setup.radar
    skirt, count = selection(plan)._skirt, 1024
    time = np.arange(count) / count
    ratio = 1.0 + radar.bandwidth_hz / radar.carrier_hz * (time - 0.5)
    step_rad = 2.0 * np.pi / radar.wavelength_m * setup.array.column_spacing(radar.wavelength_m)
    column = np.arange(setup.array.columns) - 0.5 * (setup.array.columns - 1)
    worst = np.zeros(REACH + 1)
    for sine in np.linspace(-0.9, 0.9, 400):
        # steered ahead
        pattern = np.exp(1j * step_rad * sine * np.outer(ratio, column)).mean(axis=1) ** 2
        spectrum = np.abs(np.fft.fft(pattern * (1.0 - np.cos(2.0 * np.pi * time)) / count, 8 * count))
        for off in range(REACH + 1):
            near = spectrum[np.arange(8 * off - 4, 8 * off + 5)].max()
            worst[off] = max(worst[off], near / np.abs(pattern).max())
    assert (worst <= skirt * (1.0 + 1e-6)).all()
    assert worst[2] > skirt[2] / SQUINTED


def test_plans_say_what_each_beam_chooses() -> None:
    still = planned(prepare(scene(WALL, msgspec.structs.replace(CAR, speed_mps=0.0))))
    moves = planned(prepare(scene(WALL, CAR, ego=Ego(speed_mps=1.0))))
    assert still.weakest is None
    assert moves.weakest is not None
    assert next(effect for effect in moves.effects if effect.name == "los_objects").reason.startswith(WEAKEST)
    assert moves.spent_db == pytest.approx(-20.0)
    assert len(moves.echoes) == moves.traced


def test_what_is_kept_whole() -> None:
    """A converter whose rounding is no noise: nothing bounds what weak paths change, in motion and at rest."""
    coarse = SceneRadar(front_end=FrontEnd(adc_bits=6))
    for car, why in ((CAR, MOVES), (msgspec.structs.replace(CAR, speed_mps=0.0), ROUNDS)):
        plan = planned(prepare(scene(WALL, car, radar=coarse)))
        assert (plan.weakest, plan.spent_db) == (None, None)
        assert len(plan.echoes) == plan.traced
        assert next(effect for effect in plan.effects if effect.name == "los_objects").reason.startswith(why + ":")


def test_few_paths_are_not_asked() -> None:
    """A wall and a car: the question costs more than it saves; not even one without an echo leaves."""
    plan = planned(prepare(scene(WALL, CAR)))
    paths = paths_at(plan)
    silent = replace(paths, amplitude=np.zeros_like(paths.amplitude))
    few, many = (silent.take(np.arange(count) % len(paths)) for count in (FEWEST - 1, FEWEST))
    kept, overlaps = selection(plan).selected(few, 3)
    assert kept.all()
    assert overlaps.all()
    assert not selection(plan).selected(many, 3)[0].any()


def test_same_bytes_in_any_order() -> None:
    asked = moving_place(0).scene
    one, other = (ScenePlayer(asked, effects="auto", purpose="peaks", chirps_per_beam=4) for _ in range(2))
    beams = ((0, 3), (2, 7), (1, 0))
    first = {at: one.beam(*at).samples for at in beams}
    for at in reversed(beams):
        np.testing.assert_array_equal(other.beam(*at).samples, first[at])


@pytest.mark.parametrize("count", [1, FEWEST])
@pytest.mark.parametrize("name", ["length_m", "amplitude", "azimuth_rad", "radial_speed_mps"])
def test_paths_that_are_not_finite_are_refused(name: str, count: int) -> None:
    """Few as well, though each of them stays."""
    plan = planned(prepare(scene(WALL, CAR)))
    paths = paths_at(plan)
    paths = paths.take(np.arange(count) % len(paths))
    broken = replace(paths, **{name: np.full(len(paths), np.nan)})
    with pytest.raises(ValueError, match="paths of a beam must be finite, got nan"):
        selection(plan).selected(broken, 3)


def test_nothing_at_all_is_nothing() -> None:
    plan = planned(prepare(scene(WALL, CAR)))
    kept, overlaps = selection(plan).selected(paths_at(plan).take(np.zeros(0, int)), 3)
    assert len(kept) == len(overlaps) == 0


def test_a_scene_without_overlap_gets_none() -> None:
    """`chirp_overlap` is not among the effects: no path has it."""
    plan = planned(prepare(scene(WALL, CAR)))
    effects = msgspec.structs.replace(plan.signal, chirp_overlap=False)
    chooses = Weakest(plan.setup, effects, FrontEnd(), Purpose.PEAKS, 0.1)
    for count in (FEWEST - 1, FEWEST):
        paths = paths_at(plan)
        assert not chooses.selected(paths.take(np.arange(count) % len(paths)), 12)[1].any()
