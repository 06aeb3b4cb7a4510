"""Values that tests of several rooms build alike."""

from __future__ import annotations

from models.perception.chain import Chain
from models.perception.detection.detectors import CfarDetector
from models.perception.detection.stage import DetectionStage
from models.perception.forming.ra_forming import FormingParams
from models.perception.forming.stage import FormingStage
from models.perception.tracking.scan_state import MemoryParams
from models.perception.tracking.stage import ViewStage
from msgs.values.radar import RadarSetup


def cfar_chain(setup: RadarSetup, forming: FormingParams | None = None, memory: MemoryParams | None = None) -> Chain:
    """A chain that looks with CFAR, of the defaults unless told otherwise."""
    detector = CfarDetector(setup)
    chain = Chain(FormingStage(forming), DetectionStage(lambda _: detector), ViewStage(memory=memory))
    chain.set_up(setup)
    return chain
