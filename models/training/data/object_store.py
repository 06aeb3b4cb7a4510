"""Object samples on disk: made once, read every epoch in another order."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from models.perception.geometry.mirrors import WallArrays
from models.training.data.frames import DataSet, Frame, FrameLabels, Scan
from models.training.data.object_samples import ObjectSample, ObjectTargets, SampleMaker
from models.training.data.samples import Perturbation, perturb_scan, standing
from msgs.files.array_files import load_arrays
from msgs.files.whole_files import whole
from msgs.values.array_table import stored_columns, stored_tables
from msgs.values.environment import MAX_WALL_DISTANCE_M, PriorWall
from msgs.values.frames import Pose2
from msgs.values.perception import TruthObject

SAMPLES_PER_FILE = 50
#: Shares of the training scans of which the walls are known, where the data set says them; and how far off the vehicle
#: believes to be where they are misplaced.
EXACT_WALLS_SHARE, MAP_WALLS_SHARE, MISPLACED_WALLS_SHARE = 0.1, 0.15, 0.1
MISPLACED_STD_M, MISPLACED_STD_RAD = 1.5, math.radians(2.0)
#: Files whose samples are mixed before they are drawn.
MIXED_FILES = 8


@dataclass(frozen=True)
class StoredSample:
    """A sample with what its evaluation needs: walls from the map, labels, true objects, times of its columns."""

    sample: ObjectSample
    walls: WallArrays
    labels: FrameLabels
    truth: tuple[TruthObject, ...]
    #: Of a beam, per range bin, as the data set says it.
    noise_power_mw: float
    #: Acquisition time of each column of the input after the truth's, int64 [columns].
    column_stamp_ns: np.ndarray
    #: The vehicle's motion was taken out of the map.
    ego_compensated: bool


def make_samples(data: DataSet, maker: SampleMaker, folder: Path, seed: int | None) -> list[Path]:
    """Return files of the samples of all scans, making those that are missing; see `make_file`."""
    files = sample_files(len(data), folder)
    for path, indices in files.items():
        make_file(data, indices, maker, path, seed)
    return list(files)


def sample_files(scans: int, folder: Path) -> dict[Path, range]:
    """Return the files for the samples of so many scans in a folder, and the scans of each."""
    firsts = range(0, scans, SAMPLES_PER_FILE)
    return {
        folder / f"samples-{number:05d}.npz": range(first, min(first + SAMPLES_PER_FILE, scans))
        for number, first in enumerate(firsts)
    }


def make_file(data: DataSet, indices: Sequence[int], maker: SampleMaker, path: Path, seed: int | None) -> None:
    """Write the samples of some scans where the file is missing; with a seed, half of all scans are recorded by an
    imperfect radar, half of those at rest have speeds where the network reads them, and of some the walls are known.

    Raises `ValueError` where a scan does not say its objects.
    """
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        save_samples(path, [_made(data, index, maker, seed) for index in indices])


def refuse_shared_places(train: DataSet, validation: DataSet) -> None:
    """Raise `ValueError` where a place or drive of the validation scans is trained on."""
    trained = {item for index in range(len(train)) for item in train.identity(index).items()}
    for index in range(len(validation)):
        for kind, value in validation.identity(index).items():
            if (kind, value) in trained:
                raise ValueError(
                    f"{validation.directory}: no scan may share a place with {train.directory}, scan {index} does "
                    f"(same {kind})"
                )


def _made(data: DataSet, index: int, maker: SampleMaker, seed: int | None) -> StoredSample:
    rng = np.random.default_rng((seed or 0, index))
    imperfect = seed is not None and rng.random() < 0.5
    stands = seed is not None and maker.encoding.speeds and rng.random() < 0.5

    def recorded(scan: Scan) -> Scan:
        scan = perturb_scan(scan, Perturbation(), rng, data.setup) if imperfect else scan
        return standing(scan, data.setup, rng) if stands and scan.ego is None else scan

    frame = data.frame(index, recorded)
    try:
        return stored_sample(frame, maker, () if seed is None else drawn_walls(frame, rng))
    except ValueError as error:
        raise ValueError(f"{data.directory}: {error}") from None


def drawn_walls(frame: Frame, rng: np.random.Generator) -> Sequence[PriorWall]:
    """Return what is known of the walls of a scan, if anything: as they are, as a poor map has them, or about another
    place than the vehicle's.
    """
    kind = rng.random()
    if kind < EXACT_WALLS_SHARE:
        return frame.walls
    if kind < EXACT_WALLS_SHARE + MAP_WALLS_SHARE:
        return frame.map_walls
    if kind < EXACT_WALLS_SHARE + MAP_WALLS_SHARE + MISPLACED_WALLS_SHARE:
        x_m, y_m, turn = rng.standard_normal(3)
        pose = Pose2(MISPLACED_STD_M * x_m, MISPLACED_STD_M * y_m, MISPLACED_STD_RAD * turn)
        return list(_moved(frame.walls, pose))
    return ()


def _moved(walls: Sequence[PriorWall], pose: Pose2) -> Iterator[PriorWall]:
    """Yield walls about another place, those left out that a message cannot hold there."""
    for wall in walls:
        ends_m = pose.apply(np.array(wall.ends_m))
        if np.abs(ends_m).max() <= MAX_WALL_DISTANCE_M:
            (ax, ay), (bx, by) = ends_m.tolist()
            yield msgspec.structs.replace(wall, ends_m=((ax, ay), (bx, by)))


def stored_sample(frame: Frame, maker: SampleMaker, known_walls: Sequence[PriorWall] = ()) -> StoredSample:
    """Return the sample of one frame; raises `ValueError` where it does not say its objects."""
    if frame.truth is None:
        raise ValueError(f"scan {frame.index} must say its objects, as drives and `sim dataset --truth` do")
    sample, walls = maker.sample(frame.ra_map, frame.labels, frame.truth, known_walls)
    column_stamp_ns = frame.ra_map.stamps_at(maker.encoding.cells.azimuth_rad) - frame.ra_map.stamp_ns
    moving = frame.ra_map.ego_compensated
    return StoredSample(sample, walls, frame.labels, frame.truth, frame.noise_power_mw, column_stamp_ns, moving)


def save_samples(path: Path, samples: Sequence[StoredSample]) -> None:
    """Write samples to one file, whole or not at all."""
    arrays = {
        name: np.stack([getattr(stored.sample, name) for stored in samples]) for name in ("cells", "wall", "second")
    }
    arrays |= stored_columns("targets", [stored.sample.targets for stored in samples])
    arrays |= stored_columns("walls", [stored.walls for stored in samples])
    arrays |= stored_columns("labels", [stored.labels for stored in samples])
    arrays["truth"] = np.array([msgspec.json.encode(stored.truth) for stored in samples])
    arrays["noise_power_mw"] = np.array([stored.noise_power_mw for stored in samples])
    arrays["ego_compensated"] = np.array([stored.ego_compensated for stored in samples])
    arrays["column_stamp_ns"] = np.stack([stored.column_stamp_ns for stored in samples])
    with whole(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def load_samples(path: Path) -> list[StoredSample]:
    """Return the samples of one file; raises `ValueError` naming it."""
    try:
        arrays = load_arrays(path)
        targets, walls, labels = (
            stored_tables(kind, name, arrays)
            for kind, name in ((ObjectTargets, "targets"), (WallArrays, "walls"), (FrameLabels, "labels"))
        )
        truth = [msgspec.json.decode(text, type=tuple[TruthObject, ...]) for text in arrays["truth"].tolist()]
        noise, stamps = arrays["noise_power_mw"].tolist(), arrays["column_stamp_ns"]
        moving = arrays["ego_compensated"].tolist()
        cells = zip(arrays["cells"], arrays["wall"], arrays["second"], targets, strict=True)
        samples = [ObjectSample(*parts) for parts in cells]  # type: ignore[arg-type]
        columns = samples, walls, labels, truth, noise, stamps, moving
        return [StoredSample(*parts) for parts in zip(*columns, strict=True)]
    except (KeyError, ValueError, msgspec.DecodeError) as error:
        raise ValueError(f"{path} must hold object samples: {error}") from None


def count_samples(path: Path) -> int:
    """Return the number of samples in a file without unpacking them; raises `ValueError` naming it."""
    try:
        return len(load_arrays(path, only=("noise_power_mw",))["noise_power_mw"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path} must hold object samples: {error}") from None


def shuffled(paths: Sequence[Path], rng: np.random.Generator) -> Iterator[ObjectSample]:
    """Yield the samples of all files once, mixed within a few files at a time."""
    order = rng.permutation(len(paths))
    for first in range(0, len(order), MIXED_FILES):
        pool = [stored.sample for index in order[first : first + MIXED_FILES] for stored in load_samples(paths[index])]
        yield from (pool[index] for index in rng.permutation(len(pool)))
