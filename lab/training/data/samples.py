"""Training samples: scans from disk to encoded network inputs and truth cells.

Profiles stay in memory (100 KiB a scene). Maps are formed at every use by the code that forms them on the vehicle,
which takes a millisecond, so that every epoch sees each scene through another imperfect radar.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from lab.training.data.frames import DataSet, FrameLabels, Scan, Splits, fixed_splits, scan_map, speed_unit_std_mps
from models.perception.find.encoding import Encoding, encode_columns, sample_columns
from models.perception.form.coarray import AzimuthInterpolator, beam_matrix
from msgs.values.radar import PRESETS, RadarSetup, RangeAzimuthGrid


@dataclass(frozen=True, kw_only=True)
class PointLabels:
    """Truth of one map, in fractional cells of the grid; arrays [points]."""

    row: np.ndarray
    column: np.ndarray
    path_class: np.ndarray

    def flipped(self, azimuth_bins: int) -> PointLabels:
        """Return the same points with left and right exchanged."""
        return replace(self, column=azimuth_bins - 1 - self.column)


def point_labels(labels: FrameLabels, grid: RangeAzimuthGrid) -> PointLabels:
    """Return the truth of a map in cells of its grid."""
    return PointLabels(
        row=grid.range_index(labels.range_m),
        column=grid.azimuth_index(labels.azimuth_rad),
        path_class=labels.path_class,
    )


@dataclass(frozen=True, kw_only=True)
class DenseSample:
    """A formed map: sampled columns complex64 [range, columns], its noise, and the truth."""

    columns: np.ndarray
    noise_power_mw: float
    labels: PointLabels


@dataclass(frozen=True, kw_only=True)
class Perturbation:
    """Differences between the simulated radar and a real one, drawn for each scan."""

    gain_std_db: float = 0.4
    phase_std_rad: float = 0.05
    #: Share of scans in which everything within a stretch of range moves: its phase turns from beam to beam.
    moving_share: float = 0.5
    #: Receiver noise is raised by up to this much.
    extra_noise_db: float = 6.0
    #: Share of scans that lack a beam.
    missing_share: float = 0.1


@dataclass(frozen=True, kw_only=True)
class DataConfig:
    """Data of a training and their perturbation; its fields are kept in the run folder and the card."""

    #: The data set whose fixed splits train, validate and test; and further ones that only train.
    directory: str = ""
    more: tuple[str, ...] = ()
    #: At most this many training scenes (0: all), drawn once.
    limit: int = 0
    #: Of the perturbations.
    seed: int = 0
    #: Share of the training samples formed with a perfect radar.
    clean_share: float = 0.5
    perturbation: Perturbation = Perturbation()
    encoding: Encoding = field(default_factory=Encoding)
    grid: RangeAzimuthGrid = field(default_factory=RangeAzimuthGrid)


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """Scans to train on and formed maps to validate on."""

    train: list[Scan]
    validation: list[DenseSample]
    config: DataConfig
    #: The radar that recorded them.
    setup: RadarSetup = field(default_factory=RadarSetup)


def load_training_data(config: DataConfig) -> TrainingData:
    """Return scenes of the training and validation splits, and all of the further data sets.

    Raises `ValueError` if a folder holds no data set, maps of another grid than the configuration's, more azimuth
    detail than the configured columns sample, or, in a further one, another radar or a scene, a place or a drive of the
    validation or test split.
    """
    data, splits = DataSet(Path(config.directory)), fixed_splits(Path(config.directory))
    _check_grid(data, config.grid)
    config.encoding.check_array(data.setup, config.grid)
    train = _scans(data, splits.of("train"))
    for directory in config.more:
        more = DataSet(Path(directory))
        _check_grid(more, config.grid)
        if more.setup is not data.setup:
            raise ValueError(f"{directory}: preset must be that of {config.directory}")
        _refuse_leaks(data, splits, more)
        train += _scans(more, np.arange(len(more)))
    if 0 < config.limit < len(train):
        kept = np.sort(np.random.default_rng(config.seed).permutation(len(train))[: config.limit])
        train = [train[index] for index in kept]
    former = SampleFormer(config, data.setup)
    formed = [former.sample(scan) for scan in _scans(data, splits.of("validation"))]
    return TrainingData(train=train, validation=formed, config=config, setup=data.setup)


def _check_grid(data: DataSet, grid: RangeAzimuthGrid) -> None:
    if data.grid != grid:
        raise ValueError(f"{data.directory}: grid must be {grid}, got {data.grid}")


def _scans(data: DataSet, indices: np.ndarray) -> list[Scan]:
    return [data.scan(int(index)) for index in indices]


def _refuse_leaks(data: DataSet, splits: Splits, more: DataSet) -> None:
    """Raise `ValueError` for a further data set that shares a scene, place or drive with validation or test."""
    held_out = {
        item: int(index) for index in (*splits.validation, *splits.test) for item in data.identity(index).items()
    }
    for index in range(len(more)):
        for kind, value in more.identity(index).items():
            if (scene := held_out.get((kind, value))) is not None:
                raise ValueError(
                    f"{more.directory}: no scene may be held out in {data.directory}, {index} is its scene {scene} "
                    f"(same {kind})"
                )


class SampleFormer:
    """Forms the maps of scans of a radar (None: the default) and keeps the columns of the network's input."""

    def __init__(self, config: DataConfig, setup: RadarSetup | None = None) -> None:
        self.config, self.setup = config, setup or PRESETS["xband"]
        self._interpolator = AzimuthInterpolator(self.setup, config.grid)

    def sample(self, scan: Scan, rng: np.random.Generator | None = None) -> DenseSample:
        """Return the map of a scan; with a generator, formed by an imperfect radar and augmented."""
        config = self.config
        if rng is not None and scan.profiles is not None and rng.random() >= config.clean_share:
            scan = perturb_scan(scan, config.perturbation, rng, self.setup)
        ra_map = scan_map(scan, self._interpolator)
        sample = DenseSample(
            columns=sample_columns(config.encoding, ra_map.values),
            noise_power_mw=ra_map.noise_power_mw,
            labels=point_labels(scan.labels, config.grid),
        )
        return sample if rng is None else augment(sample, config.grid.azimuth_bins, rng)

    def encode(self, samples: Sequence[DenseSample]) -> np.ndarray:
        """Return network inputs, float32 [batch, channels, range, columns]."""
        columns = np.stack([sample.columns for sample in samples])
        noise_power_mw = np.array([sample.noise_power_mw for sample in samples])
        return encode_columns(self.config.encoding, columns, noise_power_mw)


def perturb_scan(
    scan: Scan, perturbation: Perturbation, rng: np.random.Generator, setup: RadarSetup | None = None
) -> Scan:
    """Return the same scene recorded by a less perfect radar: beam gains, phases and receiver noise differ.

    For a digital array (`setup`) they are those of its columns, no single beam is missing, and nothing moves between
    beams, which have one time. Speeds of a scan that has them are less exact by that noise (`setup` must be given).
    """
    if scan.profiles is None:
        raise ValueError(f"scene {scan.index} must hold beam profiles to be perturbed, holds a map")
    if setup is not None and setup.array.digital:
        return _perturb_columns(scan, perturbation, rng, setup)
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
    speed_mps = scan.radial_speed_mps
    if speed_mps is not None and setup is not None:
        speed_mps = speed_mps + _speed_errors(profiles, added_mw, setup, rng)
    return replace(
        scan,
        profiles=profiles.astype(np.complex64),
        radial_speed_mps=speed_mps,
        noise_power_mw=scan.noise_power_mw + added_mw,
        missing_beams=tuple(sorted({*scan.missing_beams, *missing})),
    )


def _perturb_columns(scan: Scan, perturbation: Perturbation, rng: np.random.Generator, setup: RadarSetup) -> Scan:
    assert scan.profiles is not None
    columns = setup.array.columns
    gain = 10.0 ** (rng.normal(0.0, perturbation.gain_std_db, columns) / 20.0)
    factor = gain * np.exp(1j * rng.normal(0.0, perturbation.phase_std_rad, columns))
    noise_ratio = 10.0 ** (rng.uniform(0.0, perturbation.extra_noise_db) / 10.0)
    added_mw = (noise_ratio - 1.0) * scan.noise_power_mw
    noise = np.sqrt(added_mw / 2.0) * rng.standard_normal((*scan.profiles.shape, 2)) @ (1.0, 1.0j)
    matrix = beam_matrix(setup)
    profiles = (matrix * factor) @ (np.linalg.pinv(matrix) @ scan.profiles) + noise
    return replace(scan, profiles=profiles.astype(np.complex64), noise_power_mw=float(scan.noise_power_mw + added_mw))


def _speed_errors(
    profiles: np.ndarray, noise_power_mw: float, setup: RadarSetup, rng: np.random.Generator
) -> np.ndarray:
    """Return errors [beams, bins] of radial speeds by so much noise."""
    snr = np.maximum(np.abs(profiles) ** 2, noise_power_mw) / max(noise_power_mw, np.finfo(np.float64).tiny)
    return speed_unit_std_mps(setup) / np.sqrt(snr) * rng.standard_normal(profiles.shape)


def augment(sample: DenseSample, azimuth_bins: int, rng: np.random.Generator) -> DenseSample:
    """Mirror left and right half of the time, rotate the phase, and misjudge the noise by about a decibel."""
    columns, labels = sample.columns, sample.labels
    if rng.random() < 0.5:
        columns, labels = columns[:, ::-1], labels.flipped(azimuth_bins)
    return DenseSample(
        columns=columns * np.complex64(np.exp(2j * np.pi * rng.random())),
        noise_power_mw=sample.noise_power_mw * 10.0 ** (rng.normal(0.0, 0.1)),
        labels=labels,
    )


def shuffled_batches(
    scans: Sequence[Scan], former: SampleFormer, batch_size: int, seed: tuple[int, ...]
) -> Iterator[tuple[np.ndarray, np.ndarray, list[PointLabels]]]:
    """Yield one epoch of augmented batches over scenes: their indices, inputs and truth; a remainder is left out."""
    order = np.random.default_rng(seed).permutation(len(scans))
    for start in range(0, len(order) - batch_size + 1, batch_size):
        own_batch = order[start : start + batch_size]
        # each scene has its own draws
        samples = [former.sample(scans[scene], np.random.default_rng((*seed, int(scene)))) for scene in own_batch]
        yield own_batch, former.encode(samples), [sample.labels for sample in samples]
