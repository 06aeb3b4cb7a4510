"""Formed maps on disk, made once from the shards of a data set: for trainings that read thousands of maps a second.

Beside each other lie, for a shard, `NAME.truth.npz` and one `NAME.ROWSxCOLUMNS.npy` a view, which is written last. A
view holds float16 [variants, scenes, rows, columns, 2], real and imaginary parts over the map's scale: variant 0 is the
map as recorded, each further one that of another imperfect radar (`lab.training.data.samples.perturb_scan`). The
folder of shards may still grow.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from lab.training.data.frames import Scan, scan_map, shard_scans
from lab.training.data.samples import DataConfig, PointLabels, perturb_scan, point_labels
from models.perception.find.encoding import Encoding, sample_columns
from models.perception.form.coarray import AzimuthInterpolator
from msgs.files.whole_files import whole
from msgs.values.radar import RadarSetup

#: Largest magnitude of a map in an array: float16 then holds 160 dB below it.
PEAK = 8192.0


@dataclass(frozen=True)
class View:
    """Range bins and columns of an array, as `Encoding` counts them."""

    range_bins: int
    columns: int

    @classmethod
    def of(cls, encoding: Encoding) -> View:
        """Return the view that an encoding needs."""
        return cls(encoding.range_bins, encoding.columns)

    @property
    def name(self) -> str:
        """Its part of a file's name."""
        return f"{self.range_bins}x{self.columns}"


def array_path(folder: Path, shard: Path, view: View) -> Path:
    """Return the file of a view of a shard."""
    return folder / f"{shard.stem}.{view.name}.npy"


class ArrayMaker:
    """Makes the arrays of shards: some views, and so many variants of each scene."""

    def __init__(self, config: DataConfig, views: Sequence[View], variants: int, setup: RadarSetup) -> None:
        self.config, self.views, self.variants, self.setup = config, tuple(views), variants, setup
        self._interpolator = AzimuthInterpolator(setup, config.grid)

    def is_made(self, shard: Path, folder: Path) -> bool:
        """Return whether a folder has the arrays of a shard."""
        return all(array_path(folder, shard, view).exists() for view in self.views)

    def make(self, shard: Path, folder: Path, scenes: Sequence[int] | None = None) -> int:
        """Write the arrays of some scenes of one shard (None: all), where they are missing; returns how many."""
        if self.is_made(shard, folder):
            return 0
        folder.mkdir(parents=True, exist_ok=True)
        scans = shard_scans(shard)
        scans = scans if scenes is None else [scans[scene] for scene in scenes]
        arrays = [
            np.empty((self.variants, len(scans), view.range_bins, view.columns, 2), np.float16) for view in self.views
        ]
        noise = np.empty((self.variants, len(scans)), np.float32)
        for variant in range(self.variants):
            for index, scan in enumerate(scans):
                rng = np.random.default_rng((self.config.seed, variant, int(shard.stem.split("-")[-1]), index))
                noise[variant, index] = self._fill(
                    [array[variant, index] for array in arrays], scan if variant == 0 else self._imperfect(scan, rng)
                )
        _save_truth(folder / f"{shard.stem}.truth.npz", scans, self.config, noise)
        for view, array in zip(self.views, arrays, strict=True):
            with whole(array_path(folder, shard, view), ".npy") as part:
                np.save(part, array)
        return len(scans)

    def _imperfect(self, scan: Scan, rng: np.random.Generator) -> Scan:
        return scan if scan.profiles is None else perturb_scan(scan, self.config.perturbation, rng, self.setup)

    def _fill(self, places: Sequence[np.ndarray], scan: Scan) -> float:
        """Write the views of a map to their places; returns its noise over the square of its scale."""
        ra_map = scan_map(scan, self._interpolator)
        largest = float(np.abs(ra_map.values).max())
        scale = largest / PEAK if largest > 0.0 else 1.0
        for view, place in zip(self.views, places, strict=True):
            encoding = Encoding(range_bins=view.range_bins, columns=view.columns)
            values = sample_columns(encoding, ra_map.values) / scale
            place[..., 0], place[..., 1] = values.real, values.imag
        return ra_map.noise_power_mw / scale**2


def _save_truth(path: Path, scans: Sequence[Scan], config: DataConfig, noise: np.ndarray) -> None:
    labels = [point_labels(scan.labels, config.grid) for scan in scans]
    offset = np.cumsum([0, *(len(points.row) for points in labels)])
    with whole(path, ".npz") as part:
        np.savez(
            part,
            noise=noise,
            offset=offset,
            row=np.concatenate([points.row for points in labels]).astype(np.float32),
            column=np.concatenate([points.column for points in labels]).astype(np.float32),
            path_class=np.concatenate([points.path_class for points in labels]).astype(np.int64),
        )


class _Shard:
    """The arrays of one shard."""

    def __init__(self, path: Path) -> None:
        self.values = np.load(path, mmap_mode="r")
        with np.load(path.with_name(f"{path.name.split('.')[0]}.truth.npz")) as truth:
            self._truth = {name: truth[name] for name in truth.files}

    @property
    def noise(self) -> np.ndarray:
        """Noise of each variant and scene."""
        return self._truth["noise"]

    def __len__(self) -> int:
        return int(self.values.shape[1])

    @cached_property
    def labels(self) -> list[PointLabels]:
        """Truth of each scene."""
        offset = self._truth["offset"]
        return [
            PointLabels(**{name: self._truth[name][first:last] for name in ("row", "column", "path_class")})
            for first, last in itertools.pairwise(offset)
        ]


@dataclass(frozen=True)
class Maps:
    """Maps of a batch: float16 [maps, rows, columns, 2], noise float32 [maps], and their truth."""

    values: np.ndarray
    noise: np.ndarray
    labels: list[PointLabels]


class MapArrays:
    """The scenes of folders of arrays that one view has; `refresh` finds those made since."""

    def __init__(self, folders: Sequence[Path], view: View, range_bins: int | None = None) -> None:
        self.folders, self.view, self.range_bins = tuple(folders), view, range_bins or view.range_bins
        self._shards: dict[Path, _Shard] = {}
        self._scenes: list[tuple[_Shard, int]] = []
        self.refresh()

    def refresh(self) -> None:
        """Add the shards that are there and not known; those known keep their scenes' numbers."""
        for folder in self.folders:
            for path in sorted(folder.glob(f"shard-*.{self.view.name}.npy")):
                if path not in self._shards:
                    self._shards[path] = shard = _Shard(path)
                    self._scenes += [(shard, scene) for scene in range(len(shard))]

    def __len__(self) -> int:
        return len(self._scenes)

    def take(self, scenes: Sequence[int] | np.ndarray, rng: np.random.Generator | None = None) -> Maps:
        """Return maps of scenes by their numbers: as recorded, or with a generator one of their variants each."""
        places = [self._scenes[int(scene)] for scene in scenes]
        which = [0 if rng is None else int(rng.integers(shard.values.shape[0])) for shard, _ in places]
        return Maps(
            values=np.stack(
                [shard.values[v, scene, : self.range_bins] for (shard, scene), v in zip(places, which, strict=True)]
            ),
            noise=np.array(
                [shard.noise[v, scene] for (shard, scene), v in zip(places, which, strict=True)], np.float32
            ),
            labels=[shard.labels[scene] for shard, scene in places],
        )
