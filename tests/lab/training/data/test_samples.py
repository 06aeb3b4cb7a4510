from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lab.training.data.frames import FrameLabels, Scan, fixed_splits
from lab.training.data.samples import (
    DataConfig,
    DenseSample,
    Perturbation,
    PointLabels,
    SampleFormer,
    augment,
    load_training_data,
    perturb_scan,
    shuffled_batches,
)
from models.perception.find.encoding import Encoding
from models.perception.form.coarray import beam_matrix
from msgs.values.radar import PRESETS, RangeAzimuthGrid
from sim_player.dataset.writer import write_dataset

GRID = RangeAzimuthGrid(azimuth_bins=64, range_bins=32)
ENCODING = Encoding(range_bins=32, columns=8)


def sample(column: float = 20.0) -> DenseSample:
    columns = np.zeros((32, 8), np.complex64)
    columns[10, int(column) // 8] = 1.0
    truth = PointLabels(row=np.array([10.0]), column=np.array([column]), path_class=np.array([1], np.uint8))
    return DenseSample(columns=columns, noise_power_mw=1e-3, labels=truth)


def scan_of(profiles: np.ndarray, noise_power_mw: float = 0.0, index: int = 0) -> Scan:
    one = np.ones(1)
    labels = FrameLabels(
        range_m=2.0 * one,
        azimuth_rad=0.1 * one,
        path_class=one.astype(np.uint8),
        order=one,
        hidden_xy_m=np.ones((1, 2)),
        power_mw=one,
        object_index=one,
        object_class=np.array(["car"]),
    )
    return Scan(
        index=index, profiles=profiles, values=None, noise_power_mw=noise_power_mw, missing_beams=(), labels=labels
    )


def test_flip_moves_map_and_truth_together() -> None:
    """The truth stays in the lit column, on the output cell that mirrors it."""
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(20):
        one = augment(sample(20.0), 64, rng)
        lit = int(np.flatnonzero(one.columns[10])[0])
        assert int(one.labels.column[0]) // 8 == lit
        seen.add(float(one.labels.column[0]))
    assert seen == {20.0, 43.0}


def test_perturbed_noise_is_as_strong_as_it_says() -> None:
    """Layout: an empty scan of 25 x 4096 bins. Added power is the stated noise less the original; the relative
    standard deviation of a mean over 102400 cells is 0.3 %. Tolerance: five of those.
    """
    scan = scan_of(np.zeros((25, 4096), np.complex64), 2.0)
    noisy = perturb_scan(scan, Perturbation(), np.random.default_rng(1))
    added_mw = noisy.noise_power_mw - 2.0
    assert added_mw > 0.5
    assert np.mean(np.abs(noisy.profiles) ** 2) == pytest.approx(added_mw, rel=0.016)


def test_a_digital_array_is_perturbed_in_its_columns() -> None:
    """Every range is turned by one matrix that is diagonal over the columns, its factors near 1; no beam is missing."""
    setup, rng = PRESETS["77ghz"], np.random.default_rng(2)
    profiles = (rng.standard_normal((57, 64)) + 1j * rng.standard_normal((57, 64))).astype(np.complex64)
    always = Perturbation(moving_share=1.0, missing_share=1.0)
    perturbed = perturb_scan(scan_of(profiles), always, rng, setup)
    assert perturbed.profiles is not None
    assert perturbed.missing_beams == ()
    columns = np.linalg.inv(beam_matrix(setup))
    factors = (columns @ perturbed.profiles) / (columns @ profiles)
    np.testing.assert_allclose(factors, factors[:, :1] * np.ones(64), rtol=2e-3)
    assert 0.0 < np.abs(20 * np.log10(np.abs(factors))).max() < 2.0
    # noise is added to what is there, in beams as strong as it says
    noisy = perturb_scan(scan_of(np.zeros((57, 2048), np.complex64), 2.0), Perturbation(), rng, setup)
    assert noisy.profiles is not None
    assert np.mean(np.abs(noisy.profiles) ** 2) == pytest.approx(noisy.noise_power_mw - 2.0, rel=0.02)


def test_perturbation_changes_beams_not_ranges() -> None:
    """Without motion and added noise every beam keeps its profile up to one complex factor near 1.

    Gains and phases are normal: five standard deviations of 0.4 dB and 0.05 rad.
    """
    rng = np.random.default_rng(2)
    profiles = (rng.standard_normal((25, 64)) + 1j * rng.standard_normal((25, 64))).astype(np.complex64)
    scan = scan_of(profiles)
    factors = perturb_scan(scan, Perturbation(moving_share=0.0), rng).profiles / profiles
    np.testing.assert_allclose(factors, factors[:, :1] * np.ones(64), rtol=1e-5)
    assert np.abs(20 * np.log10(np.abs(factors))).max() < 2.0
    assert 0.0 < np.abs(np.angle(factors)).max() < 0.25


def test_motion_turns_the_phase_from_beam_to_beam_in_one_stretch_of_range() -> None:
    """Outside the stretch nothing turns; inside, neighbouring beams differ by one and the same phase, and magnitudes
    stay. Tolerance: complex64 rounding.
    """
    scan = scan_of(np.ones((25, 64), np.complex64))
    moved = Perturbation(gain_std_db=0.0, phase_std_rad=0.0, moving_share=1.0, missing_share=0.0)
    profiles = perturb_scan(scan, moved, np.random.default_rng(3)).profiles
    turn = profiles[1:] * profiles[:-1].conj()
    stretch = np.flatnonzero(np.abs(turn[0] - 1.0) > 1e-5)
    assert 0 < len(stretch) < 64
    assert (np.diff(stretch) == 1).all()
    np.testing.assert_allclose(turn[:, stretch], turn[0, stretch[0]], atol=1e-5)
    np.testing.assert_allclose(np.abs(profiles), 1.0, atol=1e-6)


def scans(count: int) -> list[Scan]:
    rng = np.random.default_rng(4)
    shape = (25, GRID.range_bins, 2)
    return [
        scan_of((rng.standard_normal(shape) @ (1.0, 1.0j)).astype(np.complex64), 0.1, index) for index in range(count)
    ]


def test_epoch_visits_every_scene_once_and_repeats_with_its_seed() -> None:
    former = SampleFormer(DataConfig(encoding=ENCODING, grid=GRID))
    first, again, other = (list(shuffled_batches(scans(8), former, 4, (seed, 0))) for seed in (5, 5, 6))
    assert sorted(np.concatenate([scenes for scenes, _, _ in first])) == list(range(8))
    for (_, inputs, labels), (_, same_inputs, same_labels) in zip(first, again, strict=True):
        np.testing.assert_array_equal(inputs, same_inputs)
        assert [truth.column for truth in labels] == [truth.column for truth in same_labels]
    assert any((a[1] != b[1]).any() for a, b in zip(first, other, strict=True))


@pytest.mark.slow
def test_validation_is_seen_as_it_is_and_the_same_scene_leaks_nowhere(tmp_path: Path) -> None:
    """Layout: a data set of 4 scenes; the same again as a further one, which holds scenes held out in the first."""
    write_dataset(tmp_path / "data", count=4, seed=1)
    write_dataset(tmp_path / "more", count=1, seed=2)
    splits = fixed_splits(tmp_path / "data")
    config = DataConfig(directory=str(tmp_path / "data"), more=(str(tmp_path / "more"),))
    loaded = load_training_data(config)
    assert len(loaded.train) == len(splits.train) + 1
    assert len(loaded.validation) == len(splits.validation)
    leaking = DataConfig(directory=str(tmp_path / "data"), more=(str(tmp_path / "data"),))
    first = min(*splits.validation, *splits.test)
    with pytest.raises(ValueError, match=rf"no scene may be held out in .*data, {first} is its scene {first} "):
        load_training_data(leaking)
    with pytest.raises(ValueError, match=r"grid must be RangeAzimuthGrid"):
        load_training_data(DataConfig(directory=str(tmp_path / "data"), grid=GRID))


def echoes(seed: int) -> np.ndarray:
    """Beam profiles of one scene, complex64 [25, 512]: noise alone, which is different in every scene."""
    return (np.random.default_rng(seed).standard_normal((25, 512, 2)) @ (1.0, 1.0j)).astype(np.complex64)


def write_scenes(folder: Path, seeds: list[int], drives: list[str], places: list[str]) -> Path:
    """A data set of scenes with one truth point each; which echoes, which drive and which place they show."""
    count = len(seeds)
    folder.mkdir()
    np.savez(
        folder / "shard-00000.npz",
        profiles=np.array([echoes(seed) for seed in seeds]),
        noise_power_mw=np.ones(count),
        offset=np.arange(count + 1),
        range_m=np.full(count, 5.0),
        azimuth_rad=np.zeros(count),
        path_class=np.zeros(count, np.uint8),
        sequence=np.array(drives),
        scene_yaml=np.array(places),
    )
    return folder


SCENES = 8
#: Beyond those that `held` has.
FOREIGN = 99


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of 8 drives of one scene each: 0.70, 0.85 and 1 of 8, rounded, leave 6, 1 and 1 to the splits."""
    numbers = [str(scene) for scene in range(SCENES)]
    folder = tmp_path_factory.mktemp("held") / "data"
    write_scenes(folder, list(range(SCENES)), [f"drive {one}" for one in numbers], [f"name: {one}" for one in numbers])
    splits = fixed_splits(folder)
    assert [len(splits.of(name)) for name in ("train", "validation", "test")] == [6, 1, 1]
    return folder


@pytest.mark.parametrize("split", ["train", "validation", "test"])
@pytest.mark.parametrize("same", ["echoes", "drive", "place"])
def test_what_is_held_out_is_never_trained_on(held: Path, tmp_path: Path, split: str, same: str) -> None:
    """A further data set of three scenes, of which the second shows something of one scene of a split of the first.

    What training scenes show may be seen again: all three train, beside the 6. What validation or test scenes show is
    refused, with the numbers of both scenes and what they share.
    """
    scene = int(fixed_splits(held).of(split)[0])
    shown = {what: scene if what == same else FOREIGN + 1 for what in ("echoes", "drive", "place")}
    more = write_scenes(
        tmp_path / "more",
        [FOREIGN, shown["echoes"], FOREIGN + 2],
        ["", f"drive {shown['drive']}", ""],
        ["", f"name: {shown['place']}", ""],
    )
    config = DataConfig(directory=str(held), more=(str(more),))
    if split == "train":
        assert len(load_training_data(config).train) == 6 + 3
        return
    with pytest.raises(ValueError, match=rf"held out in {held}, 1 is its scene {scene} \(same {same}\)"):
        load_training_data(config)


def test_the_second_of_several_further_data_sets_leaks_as_little(held: Path, tmp_path: Path) -> None:
    scene = int(fixed_splits(held).of("test")[0])
    clean = write_scenes(tmp_path / "clean", [FOREIGN], [""], [""])
    leaking = write_scenes(tmp_path / "leaking", [scene], [""], [""])
    with pytest.raises(ValueError, match=rf"leaking: no scene may be held out in {held}, 0 is its scene {scene}"):
        load_training_data(DataConfig(directory=str(held), more=(str(clean), str(leaking))))


def test_test_scenes_are_in_nothing_that_is_loaded(held: Path) -> None:
    """Of 8 scenes 6 train and 1 validates, by their numbers; the perfect radar's maps of both sets are no other."""
    splits = fixed_splits(held)
    loaded = load_training_data(DataConfig(directory=str(held)))
    assert [scan.index for scan in loaded.train] == splits.train
    assert not set(splits.test) & {*splits.train, *splits.validation}
    former = SampleFormer(loaded.config)
    expected = former.sample(scan_of(echoes(splits.validation[0]), 1.0))
    assert len(loaded.validation) == 1
    np.testing.assert_array_equal(loaded.validation[0].columns, expected.columns)


def test_added_noise_is_even_in_decibels_from_none_on() -> None:
    """No more noise is none; over 300 scans up to 6 dB, their mean 3 dB to within 4 sqrt(36 / 12 / 300)."""
    scan = scan_of(np.ones((3, 4), np.complex64), 2.0)
    same = perturb_scan(scan, Perturbation(extra_noise_db=0.0), np.random.default_rng(5))
    assert same.noise_power_mw == 2.0
    rng = np.random.default_rng(6)
    raised_db = [10.0 * np.log10(perturb_scan(scan, Perturbation(), rng).noise_power_mw / 2.0) for _ in range(300)]
    assert 0.0 < min(raised_db) < 0.3
    assert 5.7 < max(raised_db) <= 6.0
    assert np.mean(raised_db) == pytest.approx(3.0, abs=0.4)
