"""The judge of the ray tracer, on a scene of seconds: its groups, its gates, what is kept on disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.full_wave.comparison import EFFECTS, GATE_M, SWEEP_HZ, compare, gate_of, level_db
from benchmarks.full_wave.rays import ray_field
from benchmarks.full_wave.scenes import Box, scenes
from benchmarks.full_wave.waves import Waves, solve
from models.physics.curved_mirror import arc_points

#: A wall 20 wavelengths in front of the radar.
SMALL = scenes()[0]


@pytest.fixture(scope="module")
def waves(tmp_path_factory: pytest.TempPathFactory) -> Waves:
    return solve(SMALL, 20.0, tmp_path_factory.mktemp("waves"))


def test_rays_of_one_wall_are_the_full_wave(waves: Waves) -> None:
    """Layout: wall, target at 13 wavelengths. Analytic: image sources with Fresnel's reflection, H0 for each route.

    Bias: the grid's own reflection 0.04 dB, ripples of the wall's ends 0.1 dB, the sweep by the carrier's reflection.
    Tolerance 0.2 dB and 3 deg.
    """
    groups = {group.name: group for target in (None, "lit") for group in compare(SMALL, waves, target).groups}
    for name in ("flash", "direct", "mixed", "mirrored"):
        assert abs(groups[name].level_db) < 0.2
        assert abs(groups[name].phase_deg) < 3.0
    assert groups["mirrored"].without["specular_relay"] is None


def test_an_effect_left_out_is_an_error(waves: Waves) -> None:
    """Analytic: the mixed paths carry twice the geometric mean of direct and mirrored: without them most is missing."""
    remainder = compare(SMALL, waves, "lit").remainder
    assert remainder.relative_db < -20.0
    assert remainder.without["non_cofocal"] > remainder.relative_db + 10.0


def test_gates_hold_a_pulse_and_nothing_beyond(waves: Waves) -> None:
    gate = gate_of(waves.walls, 1.0, 1.1)
    delay_m = 299_792_458.0 * waves.walls.time_s
    assert np.all(gate[(delay_m > 0.89) & (delay_m < 1.21)] == 1.0)
    assert np.all(gate[(delay_m < 0.84) | (delay_m > 1.26)] == 0.0)


def test_kept_echoes_are_not_computed_again(tmp_path: Path) -> None:
    tiny = replace(SMALL, low_m=(-0.06, -0.06), high_m=(0.12, 0.12), longest_m=0.1, solids=(), targets={})
    runs: list[str] = []
    first = solve(tiny, 10.0, tmp_path, lambda run, share: runs.append(run))
    assert set(runs) == {"wall-walls-10"}
    again = solve(tiny, 10.0, tmp_path, lambda run, share: pytest.fail("computed again"))
    np.testing.assert_array_equal(first.walls.field, again.walls.field)


def test_solids_stand_where_the_tracer_has_its_walls() -> None:
    """Analytic: half of every cell on a face, whole cells within; an arc's own points lie on its shell's face."""
    for scene in scenes():
        grid = scene.grid(10.0)
        share = np.max([solid.share(*grid.axes_m(), grid.cell_m) for solid in scene.solids], axis=0)
        world = scene.world(None)
        for a, b, curvature in zip(world.wall_a, world.wall_b, world.wall_curvature_per_m, strict=True):
            points = arc_points(a, b, curvature, np.linspace(0.1, 0.9, 9))
            place = np.rint((points - grid.low_m) / grid.cell_m).astype(int)
            near = [share[i - 2 : i + 3, k - 2 : k + 3] for i, k in place]
            assert all(part.min() < 0.5 <= part.max() for part in near), scene.name


def test_share_of_a_box_is_its_area() -> None:
    x_m, y_m = np.arange(5.0)[:, None], np.arange(6.0)[None]
    share = Box((0.75, 1.25), (3.1, 4.0)).share(x_m, y_m, 1.0)
    assert share.sum() == pytest.approx((3.1 - 0.75) * (4.0 - 1.25))


def test_sweep_is_the_chirps() -> None:
    assert SWEEP_HZ[[0, -1]] == pytest.approx([9.65e9, 10.35e9])


@pytest.mark.parametrize(("name", "level", "phase_deg"), [("hidden", 0.79, 10.8), ("street", -1.06, 4.4)])
def test_bends_beside_the_mirror_are_what_mirrored_groups_lacked(name: str, level: float, phase_deg: float) -> None:
    """Rays without them over rays with them: the full wave says +0.79 dB, +10.8 deg and -1.06 dB, +4.4 deg of the rays
    without; within 0.3 dB and 3 deg of that.
    """
    scene = next(scene for scene in scenes() if scene.name == name)
    grid, nothing = scene.grid(20.0), np.ones(len(SWEEP_HZ), complex)
    world = scene.world(scene.node_m(grid, "hidden"))
    whole, alone = (
        ray_field(world, EFFECTS - without, grid, SWEEP_HZ, nothing) for without in (set(), {"mirrored_diffraction"})
    )
    at_m = alone.delay_m[alone.name.index("mirrored")]
    groups = [rays.field[np.abs(rays.delay_m - at_m) < GATE_M].sum(axis=0) for rays in (alone, whole)]
    assert level_db(*groups) == pytest.approx(level, abs=0.3)
    assert np.degrees(np.angle(np.vdot(groups[1], groups[0]))) == pytest.approx(phase_deg, abs=3.0)
