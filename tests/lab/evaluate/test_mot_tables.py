"""Objects and tracks of drives as MOT text."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise, permutations, product
from pathlib import Path

import numpy as np
import pytest

from lab.evaluate.mot_tables import write_mot_tables
from lab.measures.frame_scores import bootstrap_weights
from lab.measures.object_rows import HiddenRow, ImageTruth, ScanRow, TrackRow
from lab.measures.tracking_scores import tracking_scores


def hidden(object_id: int, mirrored: bool) -> HiddenRow:
    image = ImageTruth(direct=False, mirrored=mirrored, snr_db=None, single_snr_db=None)
    return HiddenRow(
        object_class="car", image=image, at_m=(1.5, -2.0), error_m=None, centre_m=None, found_by_centre=False,
        object_id=object_id,
    )  # fmt: skip


def test_rows_say_frame_id_and_centre_of_what_is_scored(tmp_path: Path) -> None:
    track = TrackRow(id=7, at_m=(1.0, 0.25), error_m=None, box_m=None)
    scans = [
        ScanRow(place=2, scan=40, hidden=[hidden(3, True), hidden(4, False)], reports=[]),
        ScanRow(place=2, scan=41, hidden=[], reports=[], tracks=[track]),
    ]
    write_mot_tables(tmp_path, {"launch/profiles/mine.yaml": scans})
    assert (tmp_path / "truth/00002/gt/gt.txt").read_text() == "1,3,-1,-1,-1,-1,1,1.500000,-2.000000,0\n"
    assert (tmp_path / "mine/00002.txt").read_text() == "2,7,-1,-1,-1,-1,1,1.000000,0.250000,0\n"


def marks(path: Path) -> list[dict[int, complex]]:
    """Read ids and centres of 6 frames of MOT text."""
    frames: list[dict[int, complex]] = [{} for _ in range(6)]
    for line in path.read_text().splitlines():
        frame, key, *_, x, y, _ = line.split(",")
        frames[int(frame) - 1][int(key)] = complex(float(x), float(y))
    return frames


def test_exported_tables_give_the_scores_by_their_definitions(tmp_path: Path) -> None:
    """Two objects and three tracks, near each other in pairs alone: IDF1 is the best assignment of whole tracks, DetA
    and AssA are counts of pairs, level by level.
    """
    rng, image = np.random.default_rng(4), ImageTruth(direct=False, mirrored=True, snr_db=None, single_snr_db=None)
    scans = []
    for number in range(6):
        objects = {3: (float(number), 0.0), 4: (float(number), 50.0)}
        tracks = {7 if number < 4 else 9: objects[3], 8: objects[4]}
        rows = [
            HiddenRow(object_class="car", image=image, at_m=at_m, error_m=None, centre_m=None, found_by_centre=False,
                      object_id=key)
            for key, at_m in objects.items() if (key, number) != (4, 2)
        ]  # fmt: skip
        moved = [
            TrackRow(id=key, at_m=(x_m + rng.uniform(0.0, 2.5), y_m), error_m=None, box_m=None)
            for key, (x_m, y_m) in tracks.items()
        ]
        scans.append(ScanRow(place=0, scan=number, hidden=rows, reports=[], tracks=moved))
    write_mot_tables(tmp_path, {"mine": scans})
    truth, said = marks(tmp_path / "truth/00000/gt/gt.txt"), marks(tmp_path / "mine/00000.txt")
    number = {key: sum(key in frame for frame in truth + said) for key in (3, 4, 7, 8, 9)}
    objects, reports = number[3] + number[4], number[7] + number[8] + number[9]

    def pairs(least: float) -> Counter[tuple[int, int]]:
        """Return in how many frames an object and a track are as alike as that."""
        alike = [
            (key, other)
            for true, own in zip(truth, said, strict=True)
            for key, other in product(true, own)
            if 1.0 - abs(true[key] - own[other]) / 2.0 >= least
        ]
        return Counter(alike)

    levels = []
    for alpha in range(1, 20):
        hits = pairs(alpha / 20.0)
        total = hits.total()
        association = sum(hit * hit / (number[key] + number[other] - hit) for (key, other), hit in hits.items())
        levels.append((total / (objects + reports - total), association / max(total, 1)))
    together = pairs(1e-9)
    best = max(together[3, first] + together[4, second] for first, second in permutations((7, 8, 9), 2))
    misses = objects - together.total()
    followed = [
        other
        for true, own in zip(truth, said, strict=True)
        for other in (7, 9)
        if other in own and abs(true[3] - own[other]) < 2.0
    ]
    changes = sum(a != b for a, b in pairwise(followed))
    scores = tracking_scores([scans], bootstrap_weights(1, 2, 0))
    assert scores.idf1.value == pytest.approx(2.0 * best / (objects + reports))
    assert scores.mota.value == pytest.approx(1.0 - (misses + reports - together.total() + changes) / objects)
    assert scores.deta.value == pytest.approx(np.mean([deta for deta, _ in levels]))
    assert scores.hota.value == pytest.approx(np.mean([math.sqrt(deta * assa) for deta, assa in levels]))
