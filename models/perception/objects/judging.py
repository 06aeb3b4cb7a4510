"""What sees the hidden objects of a scan, whichever network does."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from models.perception.geometry.association import DirectReturns
from models.perception.geometry.walls import WallParams
from models.perception.trained_radar import TrainedRadar
from msgs.values.frames import Pose2
from msgs.values.perception import HiddenObject, Peaks, Wall
from msgs.values.radar import RangeAzimuthMap


class RadarPose(NamedTuple):
    """Pose of a radar in an odometry frame of some number; poses of other frames do not compare."""

    frame: int
    odom_from_radar: Pose2


class JudgeCard(Protocol):
    """What the card of such a network says of it."""

    @property
    def name(self) -> str:
        """The file's name without its ending."""

    @property
    def radar(self) -> TrainedRadar:
        """Radar of the maps in training."""


class ScanJudge(Protocol):
    """A network that sees the hidden objects of a scan in its map, by the walls in it."""

    @property
    def card(self) -> JudgeCard:
        """Its card."""

    @property
    def walls(self) -> WallParams:
        """How the walls are fitted that it judges by."""

    def suits(self, ra_map: RangeAzimuthMap) -> bool:
        """Return whether it was trained on maps of this kind."""

    def judge(
        self,
        ra_map: RangeAzimuthMap,
        peaks: Peaks,
        walls: list[Wall],
        returns: DirectReturns,
        moving: bool = False,
        pose: RadarPose | None = None,
    ) -> Callable[[], tuple[HiddenObject, ...]]:
        """Begin with a scan; the function returned waits for its hidden objects, likeliest first.

        `pose`: of the radar, None where no vehicle state has arrived.
        """
