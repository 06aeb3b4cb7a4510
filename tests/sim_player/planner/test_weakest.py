"""Paths left out of moving scenes: the law in every cell, its parts, reasons, and what is kept whole."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from sim_player.generate.places import random_place
from sim_player.paths.path_tracks import PathTrack, Span, scene_step_s
from sim_player.paths.ray_tracing import trace
from sim_player.planner.cells import cells_of
from sim_player.planner.plan import MOVES, ROUNDS, WEAKEST, Plan, plan_world
from sim_player.planner.purposes import Purpose
from sim_player.planner.weakest import REACH, SQUINTED, Weakest, _sines
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, SceneRadar, Surface
from sim_player.scene.front_end import FrontEnd
from sim_player.scene.world import World, prepare
from sim_player.signal.levels import RANGE_BINS
from sim_player.signal.swept_echoes import swept_echoes
from tests.sim_player.planner.moving import doppler_bins, reference

WALL = Surface(
    role="relay", material="concrete", polyline_m=((20.0, -10.0), (20.0, 15.0)), height_m=6.0, thickness_mm=300
)
CAR = SceneObject(class_="car", x_m=12.0, y_m=6.0, speed_mps=5.0)
SHARES = (0.0, 0.3, 0.7, 0.999)
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
    assert plan.spans is not None
    return plan.spans


def span_of(plan: Plan, start_s: float = 0.0) -> Span:
    """The first span of a plan's scene from a time on."""
    world = plan.view.world
    return Span(*(trace(world, start_s + at_s, plan.used) for at_s in (0.0, plan.holds_s)), plan.holds_s)


@pytest.mark.slow
@pytest.mark.parametrize(("purpose", "index"), [*zip(Purpose, range(3), strict=True), (Purpose.OBJECTS, 3)])
def test_the_law_holds_in_every_cell_of_a_scan(purpose: Purpose, index: int) -> None:
    """Beams and map of one scan, each beam of its own time and span: what is left out stays under the budget, and is
    some of what there is. A budget ten times as wide breaks the law, so the test can fail.
    """
    world = moving_place(index)
    off = {}
    for budget_db in (-20.0, WIDE_DB):
        plan = planned(world, purpose, budget_db)
        kept, counts = selection(plan).kept, []

        def weak(*span: object, kept=kept, counts=counts) -> np.ndarray:  # type: ignore[no-untyped-def]
            mask = ~kept(*span)
            counts.append(mask.mean())
            return np.asarray(mask)

        left_out = PathTrack(lambda at_s, used=plan.used: trace(world, at_s, used), plan.holds_s, weak)  # type: ignore[misc]
        beams = range(len(plan.setup.beams))
        times = [1e-9 * beam * plan.setup.beam_interval_ns for beam in beams]
        left = np.stack([doppler_bins(plan, left_out.at(times[beam]), beam) for beam in beams], axis=1)
        cells = cells_of(plan.setup)
        off[budget_db] = max(float((np.abs(cells.values(one)) / reference(plan)).max()) for one in left)
        assert np.mean(counts) > 0.1
    assert off[-20.0] <= 0.1
    assert 0.1 < off[WIDE_DB] <= 1.0


def test_a_planned_beam_is_everything_but_what_is_left_out() -> None:
    """In double precision: the difference of both signals, not what is left out alone, keeps the law."""
    plan = planned(moving_place(0))
    span = span_of(plan)
    kept = selection(plan).kept(*span.ends(), plan.holds_s)
    assert 0 < kept.sum() < len(kept)
    for beam in (6, 12, 17):
        whole, less = (
            doppler_bins(plan, one.at(0.4 * plan.holds_s), beam, "float64") for one in (span, span.take(kept))
        )
        assert 0.0 < (np.abs(whole - less) / reference(plan)[beam]).max() <= 0.1


@pytest.mark.parametrize("index", range(2))
def test_fields_stay_under_their_bound_and_not_far_under_it(index: int) -> None:
    """Every path in every beam at every instant of the sweep, at four times of a span; the best beams come near."""
    plan = planned(moving_place(index))
    span = span_of(plan)
    bound = selection(plan).span(*span.ends(), plan.holds_s).magnitude
    front_end = plan.view.world.scene.radar.front_end
    for share in SHARES:
        swept = swept_echoes(plan.setup, span.at(share * plan.holds_s), plan.signal, front_end, precision="float64")
        field = np.abs(swept.weights).max(axis=0).T
        assert (field <= bound * (1.0 + 1e-5)).all()
        strong = bound.max(axis=1) > np.median(bound.max(axis=1))
        assert np.median(field.max(axis=1)[strong] / bound.max(axis=1)[strong]) > 0.8


def test_tones_stay_between_the_bins_that_they_visit() -> None:
    plan = planned(moving_place(0))
    span, bin_m = span_of(plan), plan.setup.radar.range_bin_m
    low, high = selection(plan)._visited(*span.ends(), plan.holds_s)
    for share in SHARES:
        tone = 0.5 * span.at(share * plan.holds_s).length_m / bin_m
        on_map = tone < RANGE_BINS
        assert (np.abs(tone - np.clip(tone, low, high))[on_map] <= 0.5).all()
    assert np.median(high - low) <= 3


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


def test_plans_say_how_long_they_hold() -> None:
    """At rest for ever; in motion until the next instant of tracing: 0.3 m at 5 + 1 m/s."""
    still = planned(prepare(scene(WALL, msgspec.structs.replace(CAR, speed_mps=0.0))))
    moves = planned(prepare(scene(WALL, CAR, ego=Ego(speed_mps=1.0))))
    assert (still.holds_s, still.spans) == (math.inf, None)
    assert moves.holds_s == pytest.approx(0.05, rel=1e-12)
    assert next(effect for effect in moves.effects if effect.name == "los_objects").reason.startswith(WEAKEST)
    assert moves.spent_db == pytest.approx(-20.0)
    assert len(moves.echoes) == moves.traced


def test_what_is_kept_whole() -> None:
    """A converter whose rounding is no noise: nothing bounds what weak paths change, in motion and at rest."""
    coarse = SceneRadar(front_end=FrontEnd(adc_bits=6))
    for car, why in ((CAR, MOVES), (msgspec.structs.replace(CAR, speed_mps=0.0), ROUNDS)):
        plan = planned(prepare(scene(WALL, car, radar=coarse)))
        assert (plan.spans, plan.holds_s, plan.spent_db) == (None, math.inf, None)
        assert len(plan.echoes) == plan.traced
        assert next(effect for effect in plan.effects if effect.name == "los_objects").reason.startswith(why + ":")


def test_same_bytes_in_any_order() -> None:
    asked = moving_place(0).scene
    one, other = (ScenePlayer(asked, effects="auto", purpose="peaks", chirps_per_beam=4) for _ in range(2))
    beams = ((0, 3), (2, 7), (1, 0))
    first = {at: one.beam(*at).samples for at in beams}
    for at in reversed(beams):
        np.testing.assert_array_equal(other.beam(*at).samples, first[at])
    everything = ScenePlayer(asked, effects="all", chirps_per_beam=4)
    assert len(one.beam_paths(0, 3)) < len(everything.beam_paths(0, 3))


@pytest.mark.parametrize("name", ["length_m", "amplitude", "azimuth_rad"])
def test_paths_that_are_not_finite_are_refused(name: str) -> None:
    plan = planned(prepare(scene(WALL, CAR)))
    first, last = span_of(plan).ends()
    broken = replace(last, **{name: np.full(len(last), np.nan)})
    with pytest.raises(ValueError, match="paths of a span must be finite, got nan"):
        selection(plan).kept(first, broken, plan.holds_s)


def test_ends_of_other_paths_are_refused() -> None:
    plan = planned(prepare(scene(WALL, CAR)))
    first, last = span_of(plan).ends()
    with pytest.raises(ValueError, match="must hold the same paths in the same order"):
        selection(plan).kept(first, last.take(np.arange(len(last))[1:]), plan.holds_s)
    with pytest.raises(ValueError, match="must hold the same paths in the same order"):
        selection(plan).kept(first, last.take(np.arange(len(last))[::-1]), plan.holds_s)


def test_nothing_at_all_is_nothing() -> None:
    plan = planned(prepare(scene(WALL, CAR)))
    first, last = (end.take(np.zeros(0, int)) for end in span_of(plan).ends())
    assert len(selection(plan).kept(first, last, plan.holds_s)) == 0


def test_the_step_is_that_of_the_tracer() -> None:
    world = prepare(scene(WALL, CAR))
    assert planned(world).holds_s == scene_step_s(world)


@pytest.mark.parametrize(
    ("azimuth_deg", "elevation_deg", "low", "high"),
    [
        ((20.0, 40.0), (0.0, 0.0), math.sin(math.radians(20.0)), math.sin(math.radians(40.0))),
        # past the side, by the shorter way round, and the other side
        ((80.0, 110.0), (0.0, 0.0), math.sin(math.radians(110.0)), 1.0),
        ((-80.0, -110.0), (0.0, 0.0), -1.0, -math.sin(math.radians(110.0))),
        ((170.0, -170.0), (0.0, 0.0), -math.sin(math.radians(10.0)), math.sin(math.radians(10.0))),
        # cos 60 = 1/2 and cos 0: the widest on either side of zero
        ((-30.0, 30.0), (60.0, 0.0), -0.5, 0.5),
        ((30.0, 30.0), (60.0, 0.0), 0.25, 0.5),
        ((30.0, 30.0), (-60.0, 60.0), 0.25, 0.5),
        ((30.0, 30.0), (60.0, 60.0), 0.25, 0.25),
    ],
)
def test_sines_between_two_directions(
    azimuth_deg: tuple[float, float], elevation_deg: tuple[float, float], low: float, high: float
) -> None:
    ends = np.radians(np.stack([azimuth_deg, elevation_deg], axis=1))
    assert _sines(ends) == pytest.approx((low, high), abs=1e-12)
