"""What sees the hidden objects of a scan, whichever network does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from models.perception.evidence.wall_memory import WallMemory
from models.perception.geometry.association import DirectReturns
from models.perception.geometry.walls import WallParams
from models.perception.trained_radar import TrainedRadar
from msgs.values.perception import HiddenObject, Peaks, Wall
from msgs.values.radar import RangeAzimuthMap


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
        memory: WallMemory | None = None,
    ) -> Callable[[], tuple[HiddenObject, ...]]:
        """Begin with a scan; the function returned waits for its hidden objects, likeliest first.

        `memory`: the walls of earlier scans of this radar, at its pose of this scan; it takes in those of this one.
        """
