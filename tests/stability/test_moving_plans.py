"""Hard cases of plans that hold while a scene moves: what comes, turns, jumps, stands still or is no number."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from sim_player import player as player_module
from sim_player.paths.path_tracks import Span, scene_step_s
from sim_player.paths.ray_tracing import trace
from sim_player.planner import weakest
from sim_player.planner.plan import Plan, plan_world
from sim_player.planner.purposes import Purpose
from sim_player.player import ScenePlayer
from sim_player.scene.description import Ego, Scene, SceneObject, Surface
from sim_player.scene.world import World
from tests.sim_player.planner.moving import left_out, reference
from tests.sim_player.trace.point_scenes import points_world, wall
from tests.stability.catalogue import Errors

BUDGET = 0.1
WALL = Surface(
    role="relay", material="concrete", polyline_m=((20.0, -10.0), (20.0, 15.0)), height_m=6.0, thickness_mm=300
)
CAR = SceneObject(class_="car", x_m=12.0, y_m=6.0)
CHOSEN_BEFORE = pytest.mark.hard(
    "sim_player.planner.weakest",
    "paths chosen at the instant before",
    1.0,
    "budgets",
    "the law of `peaks`",
)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even the few paths of these scenes are asked which of them go."""
    monkeypatch.setattr(weakest, "FEWEST", 0)


def planned(world: World) -> Plan:
    return plan_world(world, world.setup, purpose=Purpose.PEAKS)


def span_of(plan: Plan) -> Span:
    world = plan.view.world
    step_s = scene_step_s(world)
    return Span(trace(world, 0.0, plan.used), trace(world, step_s, plan.used), step_s)


def compare(errors: Errors, plan: Plan) -> None:
    """What goes over what the law allows, the largest of all beams at five times of a span: of the paths chosen at the
    instant before, and at the time.
    """
    step_s, span, limit = scene_step_s(plan.view.world), span_of(plan), BUDGET * reference(plan)
    before, worst = span.at(0.0), {"naive": 0.0, "ours": 0.0}
    for share in np.linspace(0.0, 0.999, 5):
        paths = span.at(share * step_s)
        for beam in range(len(plan.setup.beams)):
            for name, chosen_at in (("naive", before), ("ours", paths)):
                ratio = np.abs(left_out(plan, paths, beam, chosen_at)) / limit[beam]
                worst[name] = max(worst[name], float(ratio.max()))
    errors(**worst)


@CHOSEN_BEFORE
@pytest.mark.usefixtures("asked")
def test_an_object_comes_into_a_mirror_between_two_instants(errors: Errors) -> None:
    """A point passes the line beyond which the end of a wall mirrors it, 10 ms into a span of 43 ms: its image is not
    there at the instant before, and 40 dB over the noise after.
    """
    world = points_world(
        [(13.7, 2.0, 0.0)], wall((5.9, -6.0), (60.0, -6.0)), motion=[(7.0, 0.0)], ego=Ego(yaw_rate_dps=1e-3)
    )
    plan = planned(world)
    span = span_of(plan)
    image = span.at(0.0)
    image = image.take((image.order == 1) & (image.object_index == 0))
    assert len(image)
    assert not image.amplitude.any()
    compare(errors, plan)


@CHOSEN_BEFORE
@pytest.mark.usefixtures("asked")
def test_a_turn_sweeps_an_echo_over_a_beam_between_two_instants(errors: Errors) -> None:
    """The radar turns by 36 deg on the spot: at both instants a point stands in side lobes of the beam ahead, between
    them in its middle.
    """
    world = points_world([(14.0, 14.0 * math.tan(math.radians(18.0)), 0.0)], ego=Ego(yaw_rate_dps=120.0))
    plan = planned(replace(world, centre_rcs_m2=np.full_like(world.centre_rcs_m2, 1e-5)))
    span = span_of(plan)
    first, last = span.at(0.0), span.at(scene_step_s(world))
    assert first.azimuth_rad[0] * last.azimuth_rad[0] < 0.0
    compare(errors, plan)


@CHOSEN_BEFORE
@pytest.mark.usefixtures("asked")
def test_a_turn_brings_the_flash_of_a_wall_from_behind(errors: Errors) -> None:
    """A wall square on behind the antenna's side, where its elements see nothing: 36 deg later it flashes."""
    angle = math.radians(100.0)
    foot = 8.0 * np.array([math.cos(angle), math.sin(angle)])
    along = 10.0 * np.array([-math.sin(angle), math.cos(angle)])
    ends = [(float(x), float(y)) for x, y in (foot - along, foot + along)]
    plan = planned(points_world([(60.0, 0.0, 0.0)], wall(*ends), ego=Ego(yaw_rate_dps=120.0)))
    compare(errors, plan)


def moving_scene(speed_mps: float = 0.0, **ego: float) -> Scene:
    user = msgspec.structs.replace(CAR, speed_mps=speed_mps)
    return Scene(name="t", surfaces=(WALL,), objects=(user,), ego=Ego(**ego))


def test_at_rest_a_plan_is_kept_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is planned or traced again in a thousand scans."""
    player = ScenePlayer(moving_scene(), effects="auto", purpose="peaks", chirps_per_beam=2)
    plan = player.plan
    assert plan is not None
    assert plan.weakest is None
    monkeypatch.delattr(player_module, "resolve_plan")
    monkeypatch.delattr(ScenePlayer, "_trace")
    first, last = (player.echoes(scan, 12)[0] for scan in (0, 1000))
    np.testing.assert_array_equal(first, last)


@pytest.mark.parametrize(
    ("scene", "rule"),
    [
        (moving_scene(math.nan), r"^objects\[0\]\.speed_mps: must be finite, got nan$"),
        (moving_scene(math.inf), r"^objects\[0\]\.speed_mps: must be finite, got inf$"),
        (moving_scene(1e300), r"^objects\[0\]\.speed_mps: must lie within 10000 of 0, got 1e\+300$"),
        (moving_scene(speed_mps=1.0, yaw_rate_dps=math.nan), r"^ego\.yaw_rate_dps: must be finite, got nan$"),
    ],
)
def test_speeds_that_are_none_are_refused_before_a_plan(scene: Scene, rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        ScenePlayer(scene, effects="auto", purpose="peaks")


@pytest.mark.parametrize("scene", [moving_scene(100.0), moving_scene(speed_mps=1.0, yaw_rate_dps=720.0)])
def test_the_fastest_scenes_are_planned(scene: Scene) -> None:
    """Beams are numbers."""
    player = ScenePlayer(scene, effects="auto", purpose="peaks", chirps_per_beam=2)
    assert np.isfinite(player.echoes(0, 3)[0]).all()
