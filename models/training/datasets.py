"""Training maps: beam profiles from disk to encoded network inputs and heatmaps.

Maps are formed once, by the code that forms them on the vehicle, and kept as their sampled columns: 80 KiB each, so a
few thousand stay in memory and every epoch only encodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np

from models.perception.coarray import AzimuthInterpolator
from models.perception.encoding import Encoding, encode_columns, sample_columns
from models.training.targets import class_heatmaps
from msgs.radar import RadarSetup, RangeAzimuthGrid

#: What is read of a shard: profiles complex64 [scenes, beams, bins], noise [scenes], and the truth points of all scenes
#: in one row, those of scene i at offset[i]..offset[i + 1].
SHARD_ARRAYS = ("profiles", "noise_power_mw", "offset", "range_m", "azimuth_rad", "path_class")


@dataclass(frozen=True, kw_only=True)
class PointLabels:
    """Truth of one map, in fractional cells of the grid; arrays [points]."""

    row: np.ndarray
    column: np.ndarray
    path_class: np.ndarray

    def flipped(self, azimuth_bins: int) -> PointLabels:
        """The same points with left and right exchanged."""
        return PointLabels(row=self.row, column=azimuth_bins - 1 - self.column, path_class=self.path_class)


@dataclass(frozen=True, kw_only=True)
class BeamScan:
    """One scan of a shard: beam profiles complex64 [beams, bins], a beam's noise per bin, and the truth."""

    profiles: np.ndarray
    noise_power_mw: float
    labels: PointLabels
    missing_beams: tuple[int, ...] = ()


@dataclass(frozen=True, kw_only=True)
class DenseSample:
    """A formed map: sampled columns complex64 [range, columns], its noise, and the truth."""

    columns: np.ndarray
    noise_power_mw: float
    labels: PointLabels


@dataclass(frozen=True, kw_only=True)
class Perturbation:
    """What may differ between the simulated radar and a real one, drawn anew for each scan."""

    gain_std_db: float = 0.4
    phase_std_rad: float = 0.05
    #: Share of scans in which everything within some stretch of range moves: its phase turns from beam to beam.
    moving_share: float = 0.5
    #: Receiver noise is raised by up to this much.
    extra_noise_db: float = 6.0
    #: Share of scans that lack a beam.
    missing_share: float = 0.1


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """How a data set becomes training data."""

    #: Of the split and of the perturbations.
    seed: int = 0
    validation_share: float = 0.1
    #: Perturbed variants of each training scene beside the clean one.
    perturbed_copies: int = 1
    perturbation: Perturbation = Perturbation()
    encoding: Encoding = field(default_factory=Encoding)
    grid: RangeAzimuthGrid = field(default_factory=RangeAzimuthGrid)


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """Formed maps: for training a list of variants a scene, for validation one map a scene."""

    train: list[list[DenseSample]]
    validation: list[DenseSample]
    config: DataConfig


def load_training_data(directory: Path, config: DataConfig) -> TrainingData:
    """Form the maps of a data set, split by scene.

    Raises `ValueError` where the folder holds no shards or a shard lacks an array.
    """
    interpolator = AzimuthInterpolator(RadarSetup(), config.grid)
    scans = read_scans(directory, config.grid)
    train, validation = split_scenes(len(scans), config.validation_share, config.seed)

    def variants(scene: int) -> list[DenseSample]:
        # each scene its own draws, whatever the split
        rng = np.random.default_rng([config.seed, scene])
        copies = [perturb_scan(scans[scene], config.perturbation, rng) for _ in range(config.perturbed_copies)]
        return [form_sample(scan, interpolator, config.encoding) for scan in (scans[scene], *copies)]

    return TrainingData(
        train=[variants(scene) for scene in train],
        validation=[form_sample(scans[scene], interpolator, config.encoding) for scene in validation],
        config=config,
    )


def load_samples(directory: Path, config: DataConfig) -> list[DenseSample]:
    """Form all maps of a data set as they are; raises `ValueError` as above."""
    interpolator = AzimuthInterpolator(RadarSetup(), config.grid)
    return [form_sample(scan, interpolator, config.encoding) for scan in read_scans(directory, config.grid)]


def read_scans(directory: Path, grid: RangeAzimuthGrid) -> list[BeamScan]:
    """All scans of a data set's shards (`shard-*.npz`), in order; raises `ValueError` as above."""
    paths = sorted(directory.glob("shard-*.npz"))
    if not paths:
        raise ValueError(f"{directory} must hold shards (shard-*.npz), found none")
    _check_radar(directory / "series.json")
    return [scan for path in paths for scan in _shard_scans(path, grid)]


def _check_radar(series: Path) -> None:
    """ValueError where a data set says that it was simulated with another radar than the one maps are formed for."""
    if not series.exists():
        return
    try:
        preset = msgspec.json.decode(series.read_bytes(), type=dict).get("preset", "xband")
    except msgspec.DecodeError as error:
        raise ValueError(f"{series}: {error}") from None
    if preset != "xband":
        raise ValueError(f"{series}: preset must be xband to train on, got {preset!r}")


def _shard_scans(path: Path, grid: RangeAzimuthGrid) -> Iterator[BeamScan]:
    with np.load(path, allow_pickle=False) as shard:
        missing = [name for name in SHARD_ARRAYS if name not in shard.files]
        if missing:
            raise ValueError(f"{path} must hold the arrays {', '.join(SHARD_ARRAYS)}; it lacks {', '.join(missing)}")
        arrays = {name: shard[name] for name in SHARD_ARRAYS}
    row, column = grid.range_index(arrays["range_m"]), grid.azimuth_index(arrays["azimuth_rad"])
    for scene, (first, last) in enumerate(pairwise(arrays["offset"])):
        labels = PointLabels(
            row=row[first:last], column=column[first:last], path_class=arrays["path_class"][first:last]
        )
        yield BeamScan(
            profiles=arrays["profiles"][scene], noise_power_mw=float(arrays["noise_power_mw"][scene]), labels=labels
        )


def split_scenes(count: int, validation_share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Fixed disjoint scene indices for training and validation, both sorted."""
    if not 0.0 < validation_share < 1.0 or count < 2:
        raise ValueError(f"validation_share must be in (0, 1) of at least 2 scenes, got {validation_share} of {count}")
    order = np.random.default_rng(seed).permutation(count)
    held_out = min(max(round(count * validation_share), 1), count - 1)
    return np.sort(order[held_out:]), np.sort(order[:held_out])


def perturb_scan(scan: BeamScan, perturbation: Perturbation, rng: np.random.Generator) -> BeamScan:
    """The same scene seen by a less perfect radar: beam gains, phases and receiver noise differ."""
    beams, bins = scan.profiles.shape
    gain = 10.0 ** (rng.normal(0.0, perturbation.gain_std_db, beams) / 20.0)
    phase_rad = np.tile(rng.normal(0.0, perturbation.phase_std_rad, (beams, 1)), bins)
    if rng.random() < perturbation.moving_share:
        first, last = np.sort(rng.integers(0, bins + 1, 2))
        phase_rad[:, first:last] += rng.uniform(-np.pi, np.pi) * np.arange(beams)[:, None]
    noise_ratio = 10.0 ** (rng.uniform(0.0, perturbation.extra_noise_db) / 10.0)
    added_mw = (noise_ratio - 1.0) * scan.noise_power_mw
    noise = np.sqrt(added_mw / 2.0) * rng.standard_normal((*scan.profiles.shape, 2)) @ (1.0, 1.0j)
    profiles = gain[:, None] * np.exp(1j * phase_rad) * scan.profiles + noise
    missing = (int(rng.integers(beams)),) if rng.random() < perturbation.missing_share else ()
    return BeamScan(
        profiles=profiles.astype(np.complex64),
        noise_power_mw=scan.noise_power_mw + added_mw,
        labels=scan.labels,
        missing_beams=missing,
    )


def form_sample(scan: BeamScan, interpolator: AzimuthInterpolator, encoding: Encoding) -> DenseSample:
    """Form the map of a scan and keep the columns the network sees; noise is the map's, as on the vehicle."""
    values, _ = interpolator.interpolate(scan.profiles, scan.noise_power_mw, scan.missing_beams)
    return DenseSample(
        columns=sample_columns(encoding, values),
        noise_power_mw=scan.noise_power_mw * interpolator.noise_gain(scan.missing_beams),
        labels=scan.labels,
    )


def encode_batch(
    samples: list[DenseSample], encoding: Encoding, grid: RangeAzimuthGrid
) -> tuple[np.ndarray, np.ndarray]:
    """Network inputs float32 [batch, channels, range, columns] and heatmaps float32 [batch, 2, range, azimuth]."""
    columns = np.stack([sample.columns for sample in samples])
    noise_power_mw = np.array([sample.noise_power_mw for sample in samples])
    shape = encoding.range_bins, grid.azimuth_bins
    heatmaps = [class_heatmaps(shape, s.labels.row, s.labels.column, s.labels.path_class) for s in samples]
    return encode_columns(encoding, columns, noise_power_mw), np.stack(heatmaps)


def augment(sample: DenseSample, azimuth_bins: int, rng: np.random.Generator) -> DenseSample:
    """Mirror left and right half of the time, and misjudge the noise by a decibel or so."""
    columns, labels = sample.columns, sample.labels
    if rng.random() < 0.5:
        columns, labels = columns[:, ::-1], labels.flipped(azimuth_bins)
    return DenseSample(
        columns=columns, noise_power_mw=sample.noise_power_mw * 10.0 ** (rng.normal(0.0, 0.1)), labels=labels
    )


def shuffled_batches(
    variants: list[list[DenseSample]],
    batch_size: int,
    encoding: Encoding,
    grid: RangeAzimuthGrid,
    seed: int | tuple[int, ...],
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """One epoch of augmented batches over scenes, each given as its variants; a remainder is left out."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(variants))
    for start in range(0, len(order) - batch_size + 1, batch_size):
        chosen = [variants[scene] for scene in order[start : start + batch_size]]
        samples = [augment(scene[rng.integers(len(scene))], grid.azimuth_bins, rng) for scene in chosen]
        yield encode_batch(samples, encoding, grid)
