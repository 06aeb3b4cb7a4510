"""The perception chain with a profile's parameters, for whoever runs it without a graph."""

from __future__ import annotations

from dataclasses import dataclass

from mirrorwave.studies.tradeoff.runner import params_of
from mirrorwave.studies.tradeoff.settings import Setting, profiles
from models.perception.chain import Chain
from models.perception.detection.detectors import Detector
from models.perception.forming.ra_forming import FormingParams
from models.perception.geometry.confidence import Confidence
from msgs.values.radar import RadarSetup
from nodes.dense_predictor import detector_for
from nodes.geometry import Params, parts_of


def profile_setting(name: str) -> Setting:
    """Return a named profile; `ValueError` names those there are."""
    known = {one.value: one for one in profiles()}
    if name not in known:
        raise ValueError(f"--profile must be one of {', '.join(known)}, got {name!r}")
    return known[name]


@dataclass(frozen=True)
class ProfileParts:
    """What chains of one profile share: networks are loaded once."""

    forming: FormingParams
    detector: Detector
    geometry: Params
    confidence: Confidence | None

    @classmethod
    def of(cls, setting: Setting, setup: RadarSetup) -> ProfileParts:
        """Load the parts of a profile for a radar; `ValueError` names what is wrong, a residual network included."""
        geometry: Params = params_of(setting, "geometry")
        if geometry.residual != "none":
            raise ValueError(
                f"{setting.name}: geometry.residual must be none outside the graph, got {geometry.residual!r}"
            )
        detector = detector_for(params_of(setting, "dense_predictor"), setup)
        _, _, confidence = parts_of(geometry)
        return cls(params_of(setting, "ra_former"), detector, geometry, confidence)

    def chain(self, setup: RadarSetup) -> Chain:
        """Make a chain that has seen nothing yet."""
        return Chain(setup, self.detector, self.forming, self.geometry, self.confidence, self.geometry.memory)
