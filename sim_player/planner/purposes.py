"""Purposes of a map, each a law that a plan keeps.

One form: |RA(planned) - RA(all)| <= budget x reference in every cell of a purpose, for the same noise.

- samples: every cell; the reference is the noise rms, or the strongest |RA(all)| within one range bin and half a beam.
- peaks: every cell; the reference is the detection threshold, or the cell's own |RA(all)|. At a budget of -20 dB (0.1)
  a cell over the threshold moves by 1 dB at most, and no cell under it comes to stand over it by 1 dB.
- objects: the law of peaks in the cells where images of hidden objects and the walls that mirror them stand.

The threshold is the shipped detector's least SNR of a ridge (`RidgeParams.min_snr_db`), 13 dB over the noise of a cell.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np

from models.perception.detection.ridges import RidgeParams
from msgs.values.perception import PathClass
from msgs.values.radar import RadarSetup
from sim_player.trace.paths import Paths
from sim_player.trace.truth import best_power_mw, hidden_objects

#: Field of the least ridge over the noise rms.
DETECTION = 10.0 ** (RidgeParams().min_snr_db / 20.0)


class Purpose(StrEnum):
    """What a map is for."""

    SAMPLES = "samples"
    PEAKS = "peaks"
    OBJECTS = "objects"


def purpose_of(word: str) -> Purpose:
    """Return the purpose of a name; ValueError lists those that are known."""
    if word not in list(Purpose):
        raise ValueError(f"purpose must be one of {', '.join(Purpose)}, got {word!r}")
    return Purpose(word)


def object_paths(setup: RadarSetup, paths: Paths, noise_rms: np.ndarray) -> np.ndarray:
    """Return which paths of all effects the law of `objects` is about, bool [P]: those over the threshold in their best
    beam.

    Images: objects in a mirror that are not seen directly (`hidden_objects`). Walls: the direct echoes of the walls
    that mirror them first.
    """
    hidden = np.isin(paths.object_index, sorted(hidden_objects(paths)))
    images = _seen(setup, paths, hidden & (paths.kind == PathClass.MIRRORED), noise_rms)
    mirrors = np.setdiff1d(paths.surface[images], [-1])
    walls = (paths.object_index < 0) & (paths.kind == PathClass.LOS) & np.isin(paths.surface, mirrors)
    return np.asarray(images | _seen(setup, paths, walls, noise_rms))


def _seen(setup: RadarSetup, paths: Paths, mask: np.ndarray, noise_rms: np.ndarray) -> np.ndarray:
    """Return which of some paths, bool [P], stand over the threshold in their best beam."""
    mask = mask.copy()
    some = paths.take(mask)
    cell = np.clip(0.5 * some.length_m / setup.radar.range_bin_m, 0, len(noise_rms) - 1).astype(int)
    mask[mask] = best_power_mw(setup, some) > np.square(DETECTION * noise_rms[cell])
    return mask
