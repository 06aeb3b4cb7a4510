"""Purposes of a map, each a law that a plan keeps.

One form: |RA(planned) - RA(all)| <= budget x reference in every cell, for the same noise. The reference is the cell's
own |RA(all)| or, where that is more, a multiple of the noise rms (`LEAST`):

- samples: once the noise; for |RA(all)| the strongest within one range bin and half a beam counts.
- peaks: the detection threshold, the shipped detector's least SNR of a ridge (`RidgeParams.min_snr_db`), 13 dB over the
  noise of a cell. At a budget of -20 dB (0.1) a cell over the threshold moves by 1 dB at most, and no cell under it
  comes to stand over it by 1 dB.
- objects: 20 dB over the noise. At -20 dB a cell changes by no more than the noise's own rms, or by 1 dB where it
  stands higher: what a detector has to live with in every map. Truth points are those of everything.
"""

from __future__ import annotations

from enum import StrEnum

from models.perception.find.ridges import RidgeParams


class Purpose(StrEnum):
    """What a map is for."""

    SAMPLES = "samples"
    PEAKS = "peaks"
    OBJECTS = "objects"


#: Field of the least ridge over the noise rms.
DETECTION = 10.0 ** (RidgeParams().min_snr_db / 20.0)
#: Least reference of each law over the noise rms.
LEAST = {Purpose.SAMPLES: 1.0, Purpose.PEAKS: DETECTION, Purpose.OBJECTS: 10.0}


def purpose_of(word: str) -> Purpose:
    """Return the purpose of a name; ValueError lists those that are known."""
    if word not in list(Purpose):
        raise ValueError(f"purpose must be one of {', '.join(Purpose)}, got {word!r}")
    return Purpose(word)
