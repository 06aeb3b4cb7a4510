"""Methods of `mirrorwave eval --method`: a detector, a back end, a threshold.

A method is `NAME=SOURCE` or `SOURCE`, then words and key=value pairs with commas between them:

- SOURCE: `cfar`, `cfar-nlos` (told the true LOS points, section 4.1), `truth` (the labels themselves: what a back end
  makes of perfect peaks), or a network as FILE.onnx;
- `refine`, `refine=WAY`: where a network's peaks are placed (`models.perception.find.detectors.Refine`); without
  it they are the published local maxima;
- `flip_test`: the mean answer to a map and to the map with left and right exchanged;
- `residual=FILE.onnx`: learned correction of folded places, Eq. (18);
- `geometry=ours` (default) or `geometry=specification` (formerly `published`);
- `threshold=T`: score a peak must have; default: the network's card, none for CFAR;
- `peaks.KEY=`, `cfar.KEY=`, `nlos.KEY=`, `geometry.KEY[.KEY]=`: any parameter of that stage.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from lab.evaluate.cfar_nlos import CfarNlosParams, privileged_peaks
from lab.training.data.frames import Frame
from lab.training.data.residual_samples import truth_peaks
from models.perception.find.cfar import CfarParams
from models.perception.find.detectors import CfarDetector, NetworkDetector, Refine
from models.perception.find.onnx_model import load_card
from models.perception.find.peaks import PeakParams
from models.perception.mirrors.peaks_to_view import BackEnd, GeometryParams, fold_scan
from models.perception.mirrors.recovery import Residual
from models.perception.mirrors.residual_model import LearnedResidual
from msgs.values.perception import Peaks
from msgs.values.radar import PRESETS, RadarSetup, RangeAzimuthGrid
from nodes.process.launch_file import parse_yaml

GEOMETRIES = ("ours", "specification")
#: Parameter groups that a source can take beside `geometry`.
GROUPS = {"cfar": ("cfar",), "cfar-nlos": ("cfar", "nlos"), "truth": (), ".onnx": ("peaks",)}
WORDS = (
    "refine",
    "refine=" + "|".join(Refine),
    "flip_test",
    "residual=FILE",
    "geometry=" + "|".join(GEOMETRIES),
    "threshold=T",
)

_S = TypeVar("_S", bound=msgspec.Struct)
Detect = Callable[[Frame], Peaks]
#: Peaks -> places of all images [N, 2] in metres, and which of them are hidden, bool [N].
Place = Callable[[Peaks], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class MethodSpec:
    """A method as it was asked for."""

    name: str
    source: str
    text: str
    refine: bool | str = False
    flip_test: bool = False
    residual: Path | None = None
    geometry: BackEnd = "ours"
    threshold: float | None = None
    #: group -> dotted key -> value.
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """Key of `GROUPS`."""
        return ".onnx" if self.source.endswith(".onnx") else self.source


@dataclass(frozen=True, kw_only=True)
class Method:
    """A method ready to run."""

    name: str
    text: str
    threshold: float
    #: Weights of its networks; None where it has none.
    parameters: int | None
    #: What it is told beside the map.
    privileged: bool
    #: The grid its network was made for, None for any.
    grid: RangeAzimuthGrid | None
    detect: Detect
    place: Place


def parse_method(text: str) -> MethodSpec:
    """A method from its text; `ValueError` in one line that names the word and the rule."""
    # values in brackets keep their commas
    first, *rest = re.split(r",(?![^\[]*\])", text)
    name, separator, source = first.partition("=")
    if not separator:
        name, source = (Path(first).stem if first.endswith(".onnx") else first), first
    if not name or (source not in GROUPS and not source.endswith(".onnx")):
        raise ValueError(f"--method {text!r}: source must be cfar, cfar-nlos, truth or FILE.onnx, got {source!r}")
    parts: dict[str, Any] = {"parameters": {}}
    for word in rest:
        _take(parts, text, word)
    spec = MethodSpec(name=name, source=source, text=text, **parts)
    _check(spec)
    return spec


def _take(parts: dict[str, Any], text: str, word: str) -> None:
    """Add one word of a method's text."""
    key, separator, value = word.partition("=")
    group, dot, path = key.partition(".")
    if word in ("refine", "flip_test"):
        parts[word] = True
    elif key == "refine" and value in tuple(Refine):
        parts["refine"] = value
    elif separator and dot and path and value:
        parts["parameters"].setdefault(group, {})[path] = parse_yaml(value, f"--method {text!r}: {key}")
    elif key == "residual" and value:
        parts[key] = Path(value)
    elif key == "geometry" and value in (*GEOMETRIES, "published"):
        parts["geometry"] = value.replace("published", "specification")
    elif key == "threshold" and _is_share(value):
        parts["threshold"] = float(value)
    else:
        raise ValueError(f"--method {text!r}: must be {', '.join(WORDS)} or GROUP.KEY=VALUE, got {word!r}")


def _is_share(text: str) -> bool:
    try:
        return 0.0 < float(text) < 1.0
    except ValueError:
        return False


def _check(spec: MethodSpec) -> None:
    """Raise `ValueError` where a word does not go with the source."""
    groups = (*GROUPS[spec.kind], "geometry")
    for group in spec.parameters:
        if group not in groups:
            raise ValueError(f"--method {spec.text!r}: group must be one of {', '.join(groups)}, got {group!r}")
    for word in ("refine", "flip_test"):
        if getattr(spec, word) is not False and spec.kind != ".onnx":
            raise ValueError(f"--method {spec.text!r}: {word} must go with a network, got {spec.source}")


def build_method(spec: MethodSpec, threads: int = 1, setup: RadarSetup | None = None) -> Method:
    """Load what a method needs; `setup` None is the default radar.

    Raises `ValueError` naming the method.
    """
    try:
        return _built(spec, threads, setup or PRESETS["xband"])
    except (ValueError, msgspec.MsgspecError) as error:
        raise ValueError(f"--method {spec.name}: {error}") from None


def _built(spec: MethodSpec, threads: int, setup: RadarSetup) -> Method:
    residual, weights = _residual(spec, threads)
    grid = None
    if spec.kind == ".onnx":
        card = load_card(Path(spec.source))
        grid, weights = card.grid, weights + card.parameters
        at = spec.threshold or card.threshold_for(Refine.of(spec.refine))
        detect = _network(spec, at, threads, setup)
    else:
        at = spec.threshold or 0.0
        detector = {"cfar": _cfar, "cfar-nlos": _cfar_nlos, "truth": _truth}[spec.kind](spec, setup)
        detect = _at_least(detector, at)
    return Method(
        name=spec.name,
        text=spec.text,
        threshold=at,
        parameters=weights or None,
        privileged=spec.kind in ("cfar-nlos", "truth"),
        grid=grid,
        detect=detect,
        place=_back_end(spec, residual),
    )


def _at_least(detector: Detect, threshold: float) -> Detect:
    def detect(frame: Frame) -> Peaks:
        peaks = detector(frame)
        return peaks.take(peaks.score >= threshold)

    return detect


def _network(spec: MethodSpec, threshold: float, threads: int, setup: RadarSetup) -> Detect:
    params = msgspec.structs.replace(overridden(PeakParams(), "peaks", spec.parameters), threshold=threshold)
    detector = NetworkDetector(setup, Path(spec.source), threads, params, spec.refine, flip_test=spec.flip_test)
    return lambda frame: detector.detect(frame.ra_map)


def _cfar(spec: MethodSpec, setup: RadarSetup) -> Detect:
    detector = CfarDetector(setup, overridden(CfarParams(), "cfar", spec.parameters))
    return lambda frame: detector.detect(frame.ra_map)


def _cfar_nlos(spec: MethodSpec, _setup: RadarSetup) -> Detect:
    params = overridden(CfarNlosParams(), "nlos", spec.parameters)
    cfar = overridden(params.cfar, "cfar", spec.parameters)
    params = msgspec.structs.replace(params, cfar=cfar)

    def detect(frame: Frame) -> Peaks:
        truth = frame.labels
        return privileged_peaks(frame.ra_map, truth.range_m, truth.azimuth_rad, truth.path_class, params)

    return detect


def _truth(_spec: MethodSpec, _setup: RadarSetup) -> Detect:
    return lambda frame: truth_peaks(frame.labels)


def _back_end(spec: MethodSpec, residual: Residual | None) -> Place:
    """Return the positions from which `recover_bev` forms its points, without the objects and the visibility mask."""
    params = overridden(GeometryParams(back_end=spec.geometry), "geometry", spec.parameters)

    def place(peaks: Peaks) -> tuple[np.ndarray, np.ndarray]:
        scan = fold_scan(peaks, params, residual)
        return scan.recovered.points_m, scan.hidden

    return place


def _residual(spec: MethodSpec, threads: int) -> tuple[Residual | None, int]:
    """The learned correction in a file, and its number of weights."""
    if spec.residual is None:
        return None, 0
    residual = LearnedResidual(spec.residual, threads)
    residual.require_trained_for(spec.geometry)
    return residual, residual.card.parameters


def overridden(defaults: _S, group: str, parameters: Mapping[str, Mapping[str, Any]]) -> _S:
    """Parameters with some replaced by dotted key; `ValueError` names the group, the key and the rule."""
    plain = msgspec.to_builtins(defaults)
    for path, value in parameters.get(group, {}).items():
        *outer, last = path.split(".")
        at = plain
        for key in outer:
            at = at.get(key) if isinstance(at, dict) else None
        if not isinstance(at, dict) or last not in at:
            allowed = ", ".join(at if isinstance(at, dict) else plain)
            raise ValueError(f"{group}.{path} must be one of {allowed}")
        at[last] = value
    return msgspec.convert(plain, type(defaults))
