"""Samples of the object network: a street made for it, encoded by the vehicle's own stages, kept and read again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from models.perception.detection.cfar import CfarParams
from models.perception.detection.detectors import CfarDetector
from models.perception.forming.radial_speed import HEARD
from models.perception.objects.encoding import BINS, ObjectEncoding
from models.training.data.frames import DataSet, speed_unit_std_mps
from models.training.data.object_samples import ObjectSample, ObjectTargets, SampleMaker
from models.training.data.object_store import (
    EXACT_WALLS_SHARE,
    MAP_WALLS_SHARE,
    MISPLACED_WALLS_SHARE,
    drawn_walls,
    load_samples,
    make_samples,
    refuse_shared_places,
    shuffled,
    stored_sample,
)
from models.training.data.samples import Perturbation, perturb_scan, standing
from msgs.values.environment import MAX_WALL_DISTANCE_M
from msgs.values.radar import RadarSetup
from sim_player.dataset.shards import Recipe
from sim_player.dataset.writer import write_dataset

ENCODING = ObjectEncoding()
#: As far away as a message can say: moved, some are farther.
FAR_ENDS_M = ((MAX_WALL_DISTANCE_M, -5.0), (MAX_WALL_DISTANCE_M, 5.0))


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six scans of two drives with their true objects."""
    folder = tmp_path_factory.mktemp("drives")
    write_dataset(folder, 2, 3, Recipe(scans=3, effects="basic"))
    return folder


@pytest.fixture(scope="module")
def files(drives: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    maker = SampleMaker(ENCODING, CfarDetector(RadarSetup(), CfarParams()))
    return make_samples(DataSet(drives), maker, tmp_path_factory.mktemp("samples"), seed=5)


def test_samples_are_made_once_and_read_back_as_they_were(drives: Path, files: list[Path]) -> None:
    maker = SampleMaker(ENCODING, CfarDetector(RadarSetup(), CfarParams()))
    before = files[0].read_bytes()
    assert make_samples(DataSet(drives), maker, files[0].parent, seed=5) == files
    assert files[0].read_bytes() == before
    stored = load_samples(files[0])
    assert len(stored) == 6
    assert stored[0].sample.cells.shape == ENCODING.shape
    assert all(one.truth == DataSet(drives).scan(index).truth for index, one in enumerate(stored))
    assert {name for one in stored for name in one.labels.object_class} > {"wall"}


def test_half_of_the_scans_have_an_imperfect_radar(drives: Path, files: list[Path], tmp_path: Path) -> None:
    maker = SampleMaker(ENCODING, CfarDetector(RadarSetup(), CfarParams()))
    perfect = load_samples(make_samples(DataSet(drives), maker, tmp_path, seed=None)[0])
    # without the features of hypotheses: the walls of some scans are known
    of_map = BINS * ENCODING.map_channels
    same = [
        np.array_equal(one.sample.cells[:of_map], other.sample.cells[:of_map])
        for one, other in zip(perfect, load_samples(files[0]), strict=True)
    ]
    wanted = [np.random.default_rng((5, index)).random() >= 0.5 for index in range(6)]
    assert same == wanted
    assert 0 < sum(wanted) < 6


def test_every_sample_is_drawn_once_an_epoch_in_an_order_of_its_own(files: list[Path]) -> None:
    def drawn(seed: int) -> list[float]:
        return [float(sample.cells.sum(dtype=np.float64)) for sample in shuffled(files, np.random.default_rng(seed))]

    assert sorted(drawn(0)) == sorted(drawn(1))
    assert drawn(0) == drawn(0)
    assert drawn(0) != drawn(1)


def test_flipped_twice_is_the_sample_and_its_targets_follow(files: list[Path]) -> None:
    """A true hypothesis stays on its object: same walls, same row, the column from the other side."""
    sample = next(one.sample for one in load_samples(files[0]) if len(one.sample.targets.at))
    odd = ENCODING.odd_channels
    once, twice = sample.flipped(odd), sample.flipped(odd).flipped(odd)
    np.testing.assert_array_equal(twice.cells, sample.cells)
    for name in ("at", "place_m", "heading", "centre_m"):
        np.testing.assert_array_equal(getattr(twice.targets, name), getattr(sample.targets, name))
    np.testing.assert_array_equal(once.heat(), sample.heat()[..., ::-1])
    np.testing.assert_array_equal(once.targets.place_m, sample.targets.place_m * [1.0, -1.0])


def test_the_target_is_one_at_true_hypotheses_alone(files: list[Path]) -> None:
    samples: list[ObjectSample] = [one.sample for one in load_samples(files[0])]
    assert sum(len(sample.targets.at) for sample in samples) > 0
    for sample in samples:
        heat = sample.heat()
        assert set(map(tuple, np.argwhere(heat == 1.0).tolist())) == set(map(tuple, sample.targets.at.tolist()))
        # nothing is asked where there is no wall
        assert not heat[sample.wall < 0].any()


@pytest.mark.parametrize("harm", ["cut", "foreign", "empty"])
def test_a_file_that_is_none_is_named(files: list[Path], tmp_path: Path, harm: str) -> None:
    path = tmp_path / "samples-00000.npz"
    if harm == "foreign":
        np.savez(path, cells=np.zeros(3))
    else:
        path.write_bytes(files[0].read_bytes()[: 1000 if harm == "cut" else 0])
    with pytest.raises(ValueError, match=r"samples-00000\.npz must hold object samples"):
        load_samples(path)


def test_a_place_that_is_trained_on_validates_nothing(drives: Path, tmp_path: Path) -> None:
    write_dataset(tmp_path, 2, 4, Recipe(scans=1, effects="basic"))
    refuse_shared_places(DataSet(drives), DataSet(tmp_path))
    with pytest.raises(ValueError, match=r"no scan may share a place with .*, scan 0 does"):
        refuse_shared_places(DataSet(drives), DataSet(drives))


def test_scans_that_do_not_say_their_objects_are_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path, 1, 3, Recipe(places="street_v1"))
    maker = SampleMaker(ENCODING, CfarDetector(RadarSetup(), CfarParams()))
    with pytest.raises(ValueError, match="scan 0 must say its objects"):
        make_samples(DataSet(tmp_path), maker, tmp_path / "samples", seed=None)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> DataSet:
    """Three places at rest with their walls."""
    folder = tmp_path_factory.mktemp("places")
    write_dataset(folder, 3, 11, Recipe(effects="basic", truth=True))
    return DataSet(folder)


def test_known_walls_are_mirrors_too(places: DataSet) -> None:
    """Walls of a place that the scan shows weakly or not at all lead to objects as those in its map do."""
    maker = SampleMaker(ENCODING, CfarDetector(RadarSetup(), CfarParams()))
    for frame in places.frames(range(len(places))):
        plain, knowing = stored_sample(frame, maker), stored_sample(frame, maker, frame.walls)
        assert len(knowing.walls) > len(plain.walls)
        assert (knowing.sample.wall >= 0).sum() > (plain.sample.wall >= 0).sum()


def test_what_is_known_of_walls_is_drawn(places: DataSet) -> None:
    """Over many draws walls are as they are, as a poor map has them, misplaced, and mostly not known at all."""
    frame, rng = places.frame(0), np.random.default_rng(3)
    drawn = [drawn_walls(frame, rng) for _ in range(400)]
    shares = [
        np.mean([walls is frame.walls for walls in drawn]),
        np.mean([walls is frame.map_walls for walls in drawn]),
        np.mean([bool(walls) and walls is not frame.walls and walls is not frame.map_walls for walls in drawn]),
    ]
    np.testing.assert_allclose(shares, [EXACT_WALLS_SHARE, MAP_WALLS_SHARE, MISPLACED_WALLS_SHARE], atol=0.05)
    moved = next(walls for walls in drawn if walls and walls is not frame.walls and walls is not frame.map_walls)
    far = replace(frame, walls=tuple(msgspec.structs.replace(wall, ends_m=FAR_ENDS_M) for wall in frame.walls))
    ends_m = [wall.ends_m for _ in range(100) for wall in drawn_walls(far, rng)]
    assert np.abs(ends_m).max() <= MAX_WALL_DISTANCE_M
    lengths = [[np.hypot(*np.subtract(*wall.ends_m)) for wall in walls] for walls in (moved, frame.walls)]
    np.testing.assert_allclose(*lengths)


def test_speeds_of_a_scan_at_rest_are_noise(places: DataSet) -> None:
    """By maximum likelihood a speed errs by sqrt(6 / SNR) / T times lambda / 4 pi, rms: in those units it is 1."""
    scan, setup = places.scan(0), places.setup
    stands = standing(scan, setup, np.random.default_rng(0))
    assert stands.radial_speed_mps is not None
    assert scan.profiles is not None
    known = np.isfinite(stands.radial_speed_mps)
    snr = np.abs(scan.profiles) ** 2 / scan.noise_power_mw
    assert snr[known].min() > HEARD >= snr[~known].max()
    in_units = stands.radial_speed_mps[known] * np.sqrt(snr[known]) / speed_unit_std_mps(setup)
    assert np.sqrt(np.mean(in_units**2)) == pytest.approx(1.0, abs=0.05)
    worse = perturb_scan(stands, Perturbation(), np.random.default_rng(1), setup)
    assert worse.radial_speed_mps is not None
    assert np.nanstd(worse.radial_speed_mps) > np.nanstd(stands.radial_speed_mps)


def test_half_of_the_scans_at_rest_have_speeds(places: DataSet, tmp_path: Path) -> None:
    """Where the network reads them; without a seed none has."""
    encoding = ObjectEncoding(speeds=True)
    maker = SampleMaker(encoding, CfarDetector(RadarSetup(), CfarParams()))
    shown = [
        [
            bool(one.sample.cells[-3:].any())
            for one in load_samples(make_samples(places, maker, tmp_path / name, seed)[0])
        ]
        for name, seed in (("training", 2), ("validation", None))
    ]
    assert 0 < sum(shown[0]) < 3
    assert not any(shown[1])


def test_the_flip_exchanges_left_and_right_of_every_target() -> None:
    """Along the ray all stays, across it all changes sign, and so does the sine of twice the heading; of three columns
    the first becomes the last.
    """
    one = np.ones((1, 2), np.float32) * [1.0, 2.0]
    targets = ObjectTargets(np.array([[0, 1, 0]]), np.zeros(1, int), np.zeros(1, int), one, one + 3.0, one + 6.0, one)
    cells = np.arange(12, dtype=np.float16).reshape(2, 2, 3)
    wall = np.arange(6, dtype=np.int16).reshape(1, 2, 3)
    flipped = ObjectSample(cells, wall, wall + 6, targets).flipped([1])
    got = flipped.targets
    assert (got.at.tolist(), got.log_size.tolist()) == ([[0, 1, 2]], [[4.0, 5.0]])
    assert (got.place_m.tolist(), got.heading.tolist(), got.centre_m.tolist()) == ([[1, -2]], [[7, -8]], [[1, -2]])
    assert flipped.cells[:, 0].tolist() == [[2, 1, 0], [-8, -7, -6]]
    assert (flipped.wall[0, 0].tolist(), flipped.second[0, 0].tolist()) == ([2, 1, 0], [8, 7, 6])
