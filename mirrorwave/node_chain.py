"""The perception chain with the parameters of the nodes, as launch files, profiles and settings give them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

from models.perception.chain import Chain
from models.perception.detection.detectors import Detector
from models.perception.detection.stage import DetectionStage
from models.perception.geometry.confidence import Confidence
from models.perception.geometry.recovery import Residual
from models.perception.objects.judging import ScanJudge
from models.perception.timing import Timed
from models.perception.tracking.stage import ViewStage
from msgs.values.radar import RadarSetup
from nodes import dense_predictor, geometry, ra_former
from nodes.process.validation import convert_at

#: Node of each stage, and what its parameters are.
STAGE_PARAMS: dict[str, type[Any]] = {
    "ra_former": ra_former.Params,
    "dense_predictor": dense_predictor.Params,
    "geometry": geometry.Params,
}


def stage_params(node: str, values: Mapping[str, Any], where: str | None = None) -> Any:
    """Return a node's parameters from plain values; `ValueError` names the field that does not fit."""
    return convert_at(dict(values), STAGE_PARAMS[node], where or node)


@dataclass(frozen=True)
class NodeParams:
    """Parameters of all stages of a chain."""

    ra_former: ra_former.Params
    dense_predictor: dense_predictor.Params
    geometry: geometry.Params

    @classmethod
    def of(cls, values: Mapping[str, Mapping[str, Any]], where: str = "{node}") -> NodeParams:
        """Return the parameters of a profile or a launch file; a node that it does not name has its defaults.

        `where` says how errors call the parameters of "{node}".
        """
        return cls(**{name: stage_params(name, values.get(name, {}), where.format(node=name)) for name in STAGE_PARAMS})

    def chain(self, timed: Timed = nullcontext) -> Chain:
        """Return a chain that no set-up has reached yet; errors as the nodes'."""
        return Chain(
            ra_former.forming_stage(self.ra_former, timed),
            dense_predictor.detection_stage(self.dense_predictor, timed),
            geometry.view_stage(self.geometry, timed),
        )


@dataclass(frozen=True)
class SharedParts:
    """Parts that chains of the same parameters and the same radar share: networks and fitted models are loaded once."""

    params: NodeParams
    setup: RadarSetup
    detector: Detector
    residual: Residual | None
    confidence: Confidence | None
    predictor: ScanJudge | None

    @classmethod
    def of(cls, values: Mapping[str, Mapping[str, Any]], setup: RadarSetup) -> SharedParts:
        """Load the parts that parameters name; `ValueError` names what is wrong."""
        params = NodeParams.of(values)
        detector = dense_predictor.detector_for(params.dense_predictor, setup)
        _, residual, confidence = geometry.parts_of(params.geometry)
        predictor = geometry.predictor_of(params.geometry)
        return cls(params, setup, detector, residual, confidence, predictor)

    def chain(self) -> Chain:
        """Return a chain that has seen nothing yet."""
        placing = self.params.geometry
        chain = Chain(
            ra_former.forming_stage(self.params.ra_former),
            DetectionStage(lambda _: self.detector),
            ViewStage(placing, self.residual, self.confidence, placing.memory, predictor=self.predictor),
        )
        chain.set_up(self.setup)
        return chain
