"""The perception chain with the parameters of the nodes, as launch files, profiles and settings give them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from models.perception.chain import Chain
from models.perception.find.detectors import Detector
from models.perception.find.maps_to_peaks import DetectionStage
from models.perception.mirrors.recovery import Residual
from models.perception.see.evidence_predictor import EvidencePredictor
from models.perception.track.views_over_scans import ViewStage
from msgs.values.radar import RadarSetup
from nodes import dense_predictor, geometry, ra_former
from nodes.process.validation import convert_at

#: Node of each stage, and what its parameters are.
STAGE_PARAMS: dict[str, type[Any]] = {
    "ra_former": ra_former.Params,
    "dense_predictor": dense_predictor.Params,
    "geometry": geometry.Params,
}


def stage_params(node: str, values: Mapping[str, Any]) -> Any:
    """Return a node's parameters from plain values; `ValueError` names the field that does not fit."""
    return convert_at(dict(values), STAGE_PARAMS[node], node)


@dataclass(frozen=True)
class SharedParts:
    """Parts that chains of the same parameters and the same radar share: networks are loaded once."""

    forming: ra_former.Params
    #: Of the views.
    placing: geometry.Params
    setup: RadarSetup
    detector: Detector
    residual: Residual | None
    predictor: EvidencePredictor | None

    @classmethod
    def of(cls, values: Mapping[str, Mapping[str, Any]], setup: RadarSetup) -> SharedParts:
        """Load the parts that parameters name; `ValueError` names what is wrong."""
        forming, detection, placing = (stage_params(name, values.get(name, {})) for name in STAGE_PARAMS)
        detector = dense_predictor.detector_for(detection, setup)
        residual, predictor = geometry.residual_of(placing), geometry.predictor_of(placing)
        return cls(forming, placing, setup, detector, residual, predictor)

    def chain(self) -> Chain:
        """Return a chain that has seen nothing yet."""
        memory = self.placing.memory
        chain = Chain(
            ra_former.forming_stage(self.forming),
            DetectionStage(lambda _: self.detector),
            ViewStage(self.placing.geometry, self.residual, memory, predictor=self.predictor),
        )
        chain.set_up(self.setup)
        return chain
