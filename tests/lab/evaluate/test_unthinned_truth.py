"""Scenes traced again give the labels they gave, and more before thinning."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from lab.evaluate.unthinned_truth import DrawnScene, labelled_paths, trace_again

from sim_player.dataset.shards import Recipe, read_shard
from sim_player.dataset.writer import write_dataset
from sim_player.paths.truth import visible_paths


@pytest.mark.slow
@pytest.mark.parametrize("recipe", [Recipe(), Recipe(effects="basic"), Recipe(effects=("los_objects",))])
def test_labels_come_back_and_lie_among_all_echoes(recipe: Recipe, tmp_path: Path) -> None:
    """Planned, basic and chosen effects: thinned ranges are equal to the last bit, and each is one of all."""
    count = 8 if recipe.effects == "basic" else 2
    folder = write_dataset(tmp_path / "data", count, 3, recipe).parent
    shard, series = read_shard(folder / "shard-00000.npz"), json.loads((folder / "series.json").read_text())
    for index in range(count):
        drawn = DrawnScene(
            scene_yaml=str(shard["scene_yaml"][index]), index=index, gain_db=shard["gain_db"][index], series=series
        )
        paths, range_m = labelled_paths(drawn)
        own = slice(*shard["offset"][index : index + 2])
        assert np.array_equal(range_m, shard["range_m"][own])
        assert len(paths) >= len(range_m)
        assert np.isin(range_m, (0.5 * paths.length_m).astype(np.float32)).all()
        # thinning the echoes themselves gives as many: nothing else was left out
        assert len(visible_paths(drawn.setup, paths)) == len(range_m)


def test_a_series_planned_for_a_purpose_is_traced_again_for_it(tmp_path: Path) -> None:
    """A place whose map misses a budget of -60 dB is planned path by path: as many are kept as its shard says."""
    recipe = Recipe(effects="auto", purpose="objects", budget_db=-60.0)
    folder = write_dataset(tmp_path / "data", 1, 3, recipe).parent
    shard, series = read_shard(folder / "shard-00000.npz"), json.loads((folder / "series.json").read_text())
    drawn = DrawnScene(scene_yaml=str(shard["scene_yaml"][0]), index=0, gain_db=shard["gain_db"][0], series=series)
    kept = json.loads(bytes(shard["plan"][0]))["paths"]
    assert len(trace_again(drawn)) == kept
    del series["purpose"]
    assert len(trace_again(drawn)) > kept


def test_a_series_of_another_maker_is_refused() -> None:
    with pytest.raises(ValueError, match=r"series.json must say effects"):
        trace_again(DrawnScene(scene_yaml="", index=0, gain_db=0.0, series={"seed": 1}))


def test_scans_of_drives_are_not_traced_again() -> None:
    drawn = DrawnScene(scene_yaml="", index=0, gain_db=0.0, series={"seed": 1, "effects": "all", "scans": 12})
    with pytest.raises(ValueError, match="must be of places at rest to be traced again, scans is 12"):
        trace_again(drawn)
