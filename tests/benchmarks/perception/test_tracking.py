"""The tracking benchmark's bookkeeping: who is asked for when, and what a tracker's tracks count as."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.perception.tracking import Scan, asked_scans, scored, summary_of
from models.evaluation.object_rows import ImageTruth
from models.perception.tracking.odometry import OdometryPose, stationary_pose
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, BevGrid, SceneTruth, Track, TruthObject

PERIOD_NS = 300_000_000
SHOWN = ImageTruth(direct=False, mirrored=True, snr_db=20.0, single_snr_db=20.0)
WEAK = ImageTruth(direct=False, mirrored=True, snr_db=9.0, single_snr_db=9.0)
IN_SIGHT = ImageTruth(direct=True, mirrored=True, snr_db=20.0, single_snr_db=20.0)


def track(number: int, x_m: float, existence: float = 0.9) -> Track:
    return Track(
        id=number, x_m=x_m, y_m=0.0, velocity_x_mps=1.0, velocity_y_mps=0.0, age_s=1.0,
        cov_m2=((1.0, 0.0), (0.0, 1.0)), existence=existence,
    )  # fmt: skip


class Scripted:
    """A tracker that says what it is told to."""

    def __init__(self, *tracks: tuple[Track, ...]) -> None:
        self._tracks = iter(tracks)

    def step(
        self,
        frame: BevFrame,
        pose: OdometryPose | None,
        vehicle_from_radar: Pose2 = Pose2(),  # noqa: B008
    ) -> tuple[Track, ...]:
        return next(self._tracks)


def scans(*images: tuple[ImageTruth, ImageTruth]) -> list[Scan]:
    """A car at x = 20 at rest, and another at x = 60."""
    cars = tuple(
        TruthObject(id=number, object_class="car", x_m=x_m, y_m=0.0, length_m=4.0, width_m=2.0, yaw_rad=0.0)
        for number, x_m in enumerate((20.0, 60.0))
    )
    none = np.zeros((0, 3), np.float32)
    return [
        Scan(
            BevFrame(
                stamp_ns=number * PERIOD_NS, scan_id=number, los_points_m=np.zeros((0, 2), np.float32),
                grid=BevGrid(rows=1, columns=1), visibility=np.zeros((1, 1), np.uint8),
            ),
            SceneTruth(
                stamp_ns=number * PERIOD_NS, scan_id=number, los_points_m=none, mirrored_points_m=none,
                hidden_points_m=none, hidden_object=np.zeros(0, np.int32), objects=cars,
            ),
            stationary_pose(),
            list(shown),
        )
        for number, shown in enumerate(images)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("images", "expected"),
    [
        ([SHOWN] * 6, range(4, 6)),
        ([WEAK, SHOWN, WEAK, WEAK, WEAK, SHOWN, IN_SIGHT], range(5, 6)),
        ([SHOWN] * 4, range(4, 4)),
        ([IN_SIGHT] * 9, range(0)),
    ],
)
def test_asked_for_from_a_second_after_it_is_observable(images: list[ImageTruth], expected: range):
    """Scans are 0.3 s apart: the fourth after the first is the first that lies a second later."""
    assert list(asked_scans([number * PERIOD_NS for number in range(len(images))], images)) == list(expected)


def test_hits_false_tracks_and_changes_of_id():
    """Six scans: the car at 20 m is asked for in the last two. Track 1 is on it, lost in the fifth, then 2 is; 3 stands
    on nothing, 4 on the car in sight.
    """
    on, nothing, sight = 20.5, 40.0, 60.0
    score = scored(
        scans(*[(SHOWN, IN_SIGHT)] * 6),
        Scripted((), (track(1, on),), (track(1, on), track(3, nothing)), (track(4, sight),), (), (track(2, on, 0.7),)),
    )
    summary = summary_of("scripted", [score], 1.0)
    assert (summary.asked, summary.tracked, summary.asked_scans, summary.hits) == (1, 1, 2, 1)
    assert (summary.observable_scans, summary.observable_hits) == (6, 3)
    assert summary.id_switches == 1
    # 1.8 s
    assert summary.false_per_min == summary.plain_sight_per_min == pytest.approx(1.0 / 0.03)
    assert summary.false_share == summary.plain_sight_share == pytest.approx(1 / 5)
    # half a metre from the centre of its box, no face of which is visible; at rest, said to go 1 m/s
    assert (summary.face_rmse_m, summary.velocity_rmse_mps) == (pytest.approx(0.5), pytest.approx(1.0))
    assert summary.nees == pytest.approx(0.25)
    assert [(low, count, share) for low, _, count, _, share in summary.calibration] == [(0.7, 1, 1.0), (0.9, 4, 0.5)]
