"""Geometry: mirror images folded back through their walls, and the bird's-eye view."""

from __future__ import annotations

import logging
from collections import deque
from contextlib import nullcontext
from typing import TYPE_CHECKING, ClassVar

import msgspec

from models.perception.cards import learned_path
from models.perception.mirrors.observability import VisibilityParams
from models.perception.mirrors.peaks_to_view import FORMERLY, BackEnd, GeometryParams
from models.perception.mirrors.recovery import Residual
from models.perception.target_lists.defaults import DetectionGeometry
from models.perception.timing import Timed
from models.perception.track.scan_state import MemoryParams
from models.perception.track.views_over_scans import ViewStage
from models.perception.track.yaw_rate_bias import BiasEstimate, BiasSource
from msgs.bus.interface import Outgoing, Received
from msgs.values.arrays import require_within
from msgs.values.diagnostics import NodeState
from msgs.values.environment import WallPriors
from msgs.values.perception import BevGrid, Peaks
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from nodes.inputs.refusals import Refusals
from nodes.node import Node

if TYPE_CHECKING:
    from models.perception.see.evidence_predictor import EvidencePredictor

_LOG = logging.getLogger(__name__)

#: A map waits for its peaks; more than these have been overtaken.
KEPT_MAPS = 4
#: Peaks wait so long for their map, which takes longer to arrive: it is a hundred times as large.
MAP_PATIENCE_NS = 50_000_000
#: After so much driving without a bias of the yaw rate the node says why there is none.
BIAS_OVERDUE_S = 30.0


class Grid(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Cells of the view: columns ahead of the radar, rows to its left and right alike."""

    cell_m: float = 0.5
    rows: int = 160
    columns: int = 120

    @property
    def cells(self) -> BevGrid:
        """The grid; `ValueError` for one that there cannot be."""
        y_min_m = -0.5 * self.rows * self.cell_m
        return BevGrid(y_min_m=y_min_m, cell_m=self.cell_m, rows=self.rows, columns=self.columns)


class Mask(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Mask of the cells where an object would be detected."""

    #: Of the object: a car, -5 for a person.
    rcs_dbsm: float = VisibilityParams().rcs_dbsm


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of the geometry stage; the other numbers of its steps are constants beside them."""

    formerly: ClassVar[dict[str, str]] = {
        **FORMERLY,
        **{f"detections.{place}".rstrip("."): module for place, module in FORMERLY.items()},
        "confidence": "models.perception.mirrors.recovery",
        "grid": "msgs.values.perception",
        "detections.grid": "msgs.values.perception",
        "memory": "models.perception.track.scan_state",
        "memory.wall_map": "models.perception.track.scan_state",
        "memory.tracker": "models.perception.track.tracker",
        "memory.odometry": "models.perception.track.odometry",
        "memory.walls": "models.perception.track.scan_state",
        "memory.wall_priors": "models.perception.track.wall_fusion",
    }

    #: Walls, association and rejection: ours, or those of the specification.
    back_end: BackEnd = "ours"
    grid: Grid = Grid()
    visibility: Mask = Mask()
    #: An exported residual network with its card beside it, or the name of a committed one, trained on walls of the
    #: same back end; `none`: the mirror law alone.
    residual: str = "none"
    #: An exported evidence network with its card beside it, or the name of a committed one, which sees objects in the
    #: map, or in one made of a list of detections; `none`, and maps of other sensors: objects are clusters of folded
    #: places.
    object_network: str = "none"
    #: Least probability of a reported object, but of lists; None: the card's. Its mean answer to scan and mirror image.
    object_threshold: float | None = None
    object_flip_test: bool = False
    #: What is kept from scan to scan: odometry, tracks, walls.
    memory: MemoryParams = MemoryParams()
    #: For peaks of a radar that gives detections: they come with the limits of their sensor.
    detections: DetectionGeometry = DetectionGeometry()

    def __post_init__(self) -> None:
        # what the stage refuses is refused here
        _ = self.geometry, self.detections.geometry
        if self.object_threshold is not None:
            require_within("object_threshold", 0.0, 1.0, self.object_threshold)
        if self.back_end == "specification" and self.object_network != "none":
            raise ValueError(
                "object_network must be none with back_end specification, which has no such part, "
                f"got {self.object_network!r}"
            )

    @property
    def geometry(self) -> GeometryParams:
        """Parameters of the stage for maps."""
        visibility = VisibilityParams(rcs_dbsm=self.visibility.rcs_dbsm)
        return GeometryParams(back_end=self.back_end, grid=self.grid.cells, visibility=visibility)


class GeometryNode(Node):
    """perception/peaks -> perception/hidden_objects, with tracks and the vehicle's motion at the time of the scan; an
    object network needs radar/setup and radar/ra_map too. Walls on environment/walls, if any, are fused with those of
    the scans.
    """

    inputs: tuple[str, ...] = ("perception/peaks", "vehicle/state", "environment/walls")
    outputs = ("perception/hidden_objects",)

    def __init__(self, params: Params) -> None:
        super().__init__()
        # loaded here: a missing or broken file shows at start, not at the first scan
        self._stage = view_stage(params, self.stages)
        self._memory = params.memory
        if self._stage.predictor is not None:
            self.inputs = ("radar/setup", "radar/ra_map", *self.inputs)
        self._maps: deque[RangeAzimuthMap] = deque(maxlen=KEPT_MAPS)
        #: Peaks whose map has not arrived, oldest first, and when their wait is over.
        self._waiting: deque[tuple[Peaks, int]] = deque()
        self._refusals = Refusals(_LOG, self.shed)
        self._bias_log = BiasLog()

    def step(self, inputs: list[Received], now_ns: int) -> list[Outgoing]:
        """Return one view per set of peaks; what the stage cannot take is refused, counted and logged."""
        out: list[Outgoing] = []
        for received in sorted(inputs, key=lambda item: item.topic == "perception/peaks"):
            match received.message:
                case VehicleState() as state:
                    self._stage.add_state(state)
                case WallPriors() as walls:
                    self._stage.add_walls(walls)
                case RadarSetup() as setup:
                    self._set_up(setup)
                case RangeAzimuthMap() as ra_map:
                    self._maps.append(ra_map)
                    if self._stage.predictor is not None:
                        self._stage.predictor.expect(ra_map)
                case Peaks() as peaks:
                    self._waiting.append((peaks, now_ns + MAP_PATIENCE_NS))
        # views go out in the order of their scans: peaks that others follow wait no longer than these
        while self._waiting and self._is_ready(*self._waiting[0], now_ns):
            out += self._seen(self._waiting.popleft()[0])
        return out

    def change_params(self, params: Params) -> None:
        """See by other parameters from the next peaks on; tracks and walls are kept."""
        if (params.object_network == "none") != (self._stage.predictor is None):
            raise ValueError("object_network: whether there is one is fixed at its start: with one it listens to maps")
        if params.memory != self._memory:
            raise ValueError("memory: what is kept from scan to scan is fixed when it starts")
        stage = view_stage(params, self.stages)
        stage.take_over(self._stage)
        self._stage = stage

    def due_ns(self, now_ns: int) -> int | None:
        """Return when the wait for a map is over."""
        return self._waiting[0][1] if self._waiting else None

    def _is_ready(self, peaks: Peaks, give_up_ns: int, now_ns: int) -> bool:
        return now_ns >= give_up_ns or not self._needs_map(peaks) or self._map_of(peaks) is not None

    def health(self) -> tuple[NodeState, str]:
        """Report DEGRADED while peaks are refused, and of a radar that the object network was not trained for."""
        if not self._refusals.reason and self._stage.doubt:
            return NodeState.DEGRADED, self._stage.doubt
        return self._refusals.health()

    def _set_up(self, setup: RadarSetup) -> None:
        """See by another set-up; one that cannot be used changes nothing."""
        try:
            self._stage.set_up(setup)
        except ValueError as error:
            self._refusals.refuse("setup", error)

    def _seen(self, peaks: Peaks) -> list[Outgoing]:
        ra_map = self._counted_map_of(peaks)
        view = self._refusals.attempt("scan", lambda: self._stage.view(peaks, ra_map), f"scan {peaks.scan_id}")
        if view is None:
            return []
        self._bias_log.note(self._stage.yaw_rate_bias)
        return [Outgoing("perception/hidden_objects", view)]

    def _needs_map(self, peaks: Peaks) -> bool:
        """Return whether objects are judged in a map that comes; of a radar that gives detections none does."""
        return self._stage.predictor is not None and peaks.sensor is None

    def _map_of(self, peaks: Peaks) -> RangeAzimuthMap | None:
        """Return the map that peaks were detected in, if it has arrived."""
        own = (item for item in self._maps if (item.stamp_ns, item.scan_id) == (peaks.stamp_ns, peaks.scan_id))
        return next(own, None)

    def _counted_map_of(self, peaks: Peaks) -> RangeAzimuthMap | None:
        """Return the map that objects are judged in; one that the bus has dropped is counted."""
        if not self._needs_map(peaks):
            return None
        ra_map = self._map_of(peaks)
        if ra_map is None:
            self.shed.add("view", "made without a map")
        return ra_map


class BiasLog:
    """Log of the source of the estimated yaw rate bias, a line a change."""

    def __init__(self) -> None:
        self._source: BiasSource | None = None

    def note(self, bias: BiasEstimate) -> None:
        """Take in the bias after a scan."""
        is_unknown = bias.source is BiasSource.NONE
        if bias.source == self._source or (is_unknown and bias.driven_s < BIAS_OVERDUE_S):
            return
        self._source = bias.source
        _LOG.log(logging.WARNING if is_unknown else logging.INFO, "%s", bias)


def view_stage(params: Params, timed: Timed = nullcontext) -> ViewStage:
    """Return the stage that parameters name; errors as `residual_of`."""
    residual, predictor = residual_of(params), predictor_of(params)
    return ViewStage(params.geometry, residual, params.memory, timed, predictor, params.detections.geometry)


def residual_of(params: Params) -> Residual | None:
    """Return the residual network that parameters name; raises `ValueError` naming a file that is missing or broken."""
    if params.residual == "none":
        return None
    # here: without a network this node starts again faster by what bringing its runtime along takes
    from models.perception.mirrors.residual_model import LearnedResidual

    residual = LearnedResidual(learned_path(params.residual))
    residual.require_trained_for(params.back_end)
    return residual


def predictor_of(params: Params) -> EvidencePredictor | None:
    """Return the object network that parameters name; raises `ValueError` naming a file that is missing or broken."""
    if params.object_network == "none":
        return None
    # as the residual: the runtime comes along only where it is needed
    from models.perception.see.evidence_predictor import EvidencePredictor

    path = learned_path(params.object_network)
    return EvidencePredictor(path, threshold=params.object_threshold, flip_test=params.object_flip_test)


def create(params: Params) -> GeometryNode:
    """Return the node with its parameters."""
    return GeometryNode(params)


#: It opens its networks and nothing else.
check = create
