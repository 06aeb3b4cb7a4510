"""The shifted series: what is changed, by how much, and that the series it comes from stays as it was."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from lab.training.data.frames import DataSet
from msgs.values.radar import RadarSetup
from sim_player.dataset.domain_shift import (
    HARD,
    RADAR_ROOM_M,
    BoardFaults,
    ShiftParams,
    domain_shifted_scene,
    draw_faults,
    faulty_profiles,
)
from sim_player.dataset.labelled_scan import noise_power_mw, profile_noise
from sim_player.dataset.shards import Recipe, draw_scene, read_shard
from sim_player.dataset.writer import write_dataset
from sim_player.generate.places import random_place
from sim_player.generate.wall_kinds import known

SETUP = RadarSetup()
BEAMS = len(SETUP.beams)


@pytest.fixture(scope="module")
def hard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two shifted streets."""
    recipe = Recipe(effects="basic", shift="hard", scenes_per_shard=2)
    return write_dataset(tmp_path_factory.mktemp("hard"), 2, 5, recipe).parent


def test_surfaces_are_rougher_and_clutter_is_added() -> None:
    """20 places: one factor of 2..3 for all surfaces there were, 4..11 pieces of clutter (fewer where none has room),
    every one at least 3 m off the radar; objects stay."""
    added = []
    for index in range(20):
        scene = random_place(4, index)
        shifted = domain_shifted_scene(scene, np.random.default_rng(index))
        assert shifted.objects == scene.objects
        old = np.array([surface.roughness_mm for surface in scene.surfaces])
        new = np.array([surface.roughness_mm for surface in shifted.surfaces])[: len(old)]
        factor = new[old > 0.0] / old[old > 0.0]
        assert 2.0 <= factor.min() <= factor.max() <= 3.0
        np.testing.assert_allclose(factor, factor[0], rtol=1e-12)
        clutter = shifted.surfaces[len(old) :]
        added.append(len(clutter))
        assert all(min(map(np.linalg.norm, surface.polyline_m)) >= RADAR_ROOM_M for surface in clutter)
    assert max(added) <= 11
    assert np.mean(added) >= 4.0


def test_a_full_place_takes_no_clutter_but_stays_a_scene() -> None:
    """Walls every 0.8 m: no outline finds 0.4 m on all sides."""
    scene = random_place(4, 1)
    wall = scene.surfaces[0]
    bars = tuple(
        msgspec.structs.replace(wall, polyline_m=((x, -60.0), (x, 60.0)), curvature_per_m=0.0)
        for x in np.arange(1.0, 45.0, 0.75).tolist()
    )
    full = msgspec.structs.replace(scene, surfaces=bars, objects=())
    assert len(domain_shifted_scene(full, np.random.default_rng(0)).surfaces) == len(bars)


def test_no_shift_of_nothing() -> None:
    """Bands of width zero give the scene and the profiles back, bit for bit."""
    nothing = ShiftParams(
        roughness_factor=(1.0, 1.0), posts=(0, 0), signs=(0, 0), bushes=(0, 0), beam_gain=(1.0, 1.0),
        beam_phase_deg=0.0, dead_beams=(0, 0),
    )  # fmt: skip
    scene = random_place(4, 2)
    rng = np.random.default_rng(1)
    assert domain_shifted_scene(scene, rng, nothing) == scene
    profiles = profile_noise(SETUP, 3).astype(np.complex64)
    same = faulty_profiles(profiles, draw_faults(rng, BEAMS, nothing), SETUP, 3)
    assert same.tobytes() == profiles.tobytes()


def test_boards_have_the_stated_faults() -> None:
    """400 boards: gains 0.6..1, mean 0.8 to 0.01; phases 10 deg rms to 0.3; one or two dead beams, each as often."""
    boards = [draw_faults(np.random.default_rng(seed), BEAMS) for seed in range(400)]
    gain = np.stack([board.gain for board in boards])
    assert 0.6 <= np.abs(gain).min() <= np.abs(gain).max() <= 1.0
    assert np.abs(gain).mean() == pytest.approx(0.8, abs=0.01)
    assert np.degrees(np.angle(gain)).std() == pytest.approx(HARD.beam_phase_deg, abs=0.3)
    dead = np.array([board.dead.sum() for board in boards])
    assert set(dead.tolist()) == {1, 2}
    assert (dead == 1).mean() == pytest.approx(0.5, abs=0.1)
    lone = draw_faults(np.random.default_rng(0), 1, ShiftParams(dead_beams=(3, 3)))
    assert not lone.dead.any()


def test_echoes_weaken_and_noise_does_not() -> None:
    """Echo of 1 in all cells under gain 0.6 exp(j 0.3): the mean over 60 draws of 512 bins is the gain (to 2 %), and
    what varies is thermal noise as before (to 3 %); a dead beam holds zeros."""
    noise_mw = noise_power_mw(SETUP)
    gain = np.full(BEAMS, 0.6 * np.exp(0.3j))
    dead = np.arange(BEAMS) == 7
    echo = 10.0 * np.sqrt(noise_mw)
    scans = [(echo + profile_noise(SETUP, seed)).astype(np.complex64) for seed in range(0, 120, 2)]
    board = BoardFaults(gain, dead)
    found = np.stack([faulty_profiles(scan, board, SETUP, 2 * index) for index, scan in enumerate(scans)])
    assert not found[:, 7].any()
    alive = found[:, ~dead]
    assert alive.mean() / echo == pytest.approx(gain[0], rel=0.02)
    assert np.mean(np.abs(alive - gain[0] * echo) ** 2) == pytest.approx(noise_mw, rel=0.03, abs=0.0)


def test_shards_say_which_beams_are_missing(hard: Path) -> None:
    """The array agrees with the zeros in the profiles, the map former hears of it, and the folder states the shift."""
    shard = read_shard(hard / "shard-00000.npz")
    missing = shard["missing_beams"]
    assert missing.shape == (2, BEAMS)
    assert missing.dtype == bool
    np.testing.assert_array_equal(missing, ~shard["profiles"].any(axis=2))
    assert set(missing.sum(axis=1).tolist()) <= {1, 2}
    assert shard["beam_gain"].shape == (2, BEAMS)
    series = msgspec.json.decode((hard / "series.json").read_bytes())
    assert series["shift"].pop("name") == "hard"
    assert msgspec.convert(series["shift"], ShiftParams) == HARD
    frame = DataSet(hard).frame(1)
    assert frame.ra_map.missing_beams == tuple(np.flatnonzero(missing[1]).tolist())
    assert np.isfinite(frame.ra_map.values).all()


def test_same_seed_same_bytes(tmp_path: Path, hard: Path) -> None:
    """One scene first, then both: the folder knows its own series again."""
    recipe = Recipe(effects="basic", shift="hard", scenes_per_shard=2)
    write_dataset(tmp_path, 1, 5, recipe)
    again = write_dataset(tmp_path, 2, 5, recipe).parent
    assert (again / "shard-00000.npz").read_bytes() == (hard / "shard-00000.npz").read_bytes()


def test_series_without_shift_are_as_they_were(tmp_path: Path, hard: Path) -> None:
    """No new key in series.json, no new array in a shard; the hard series has the places of the plain one."""
    recipe = Recipe(effects="basic", scenes_per_shard=2)
    assert "shift" not in recipe.described(5)
    plain = read_shard(write_dataset(tmp_path, 2, 5, recipe).parent / "shard-00000.npz")
    assert not {"missing_beams", "beam_gain"} & plain.keys()
    shifted, _ = draw_scene(msgspec.structs.replace(recipe, shift="hard"), 5, 1)
    assert shifted.objects == random_place(5, 1).objects
    assert shifted != random_place(5, 1)
    with pytest.raises(ValueError, match=r"holds another data set: shift None, wanted \{.*hard"):
        write_dataset(tmp_path, 2, 5, msgspec.structs.replace(recipe, shift="hard"))


def test_clutter_stands_at_millimetre_waves_too() -> None:
    assert known("vegetation", "77ghz")
    domain_shifted_scene(random_place(4, 3, "77ghz"), np.random.default_rng(2))
