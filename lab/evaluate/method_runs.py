"""Running methods over the same frames, interleaved frame by frame, and what is kept of it: answers, times, truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from lab.evaluate.methods import Method
from lab.measures.frame_scores import FrameAnswer, FrameScores, FrameTruth, score_frames
from lab.training.data.frames import DataSet, Frame, FrameLabels
from msgs.values.frames import xy_from_polar
from msgs.values.perception import PathClass, Peaks
from msgs.values.units import s_from_ns

if TYPE_CHECKING:
    from sim_player.dataset.labelled_scan import Labels

#: Called after each step of a long loop.
Tick = Callable[[], None]
MS_PER_S = 1e3


@dataclass
class MethodRun:
    """Answers of one method for every frame, in order."""

    method: Method
    answers: list[FrameAnswer] = field(default_factory=list)
    #: Milliseconds of detection and of geometry.
    milliseconds: list[tuple[float, float]] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Run:
    """Methods over frames: index and truth of each frame, then each method's answers."""

    indices: list[int]
    truth: list[FrameTruth]
    runs: list[MethodRun]

    def scores(self, run: MethodRun) -> FrameScores:
        """Rows of one method against the truth."""
        return score_frames(zip(run.answers, self.truth, strict=True))


def checked_frames(data: DataSet, indices: Iterable[int], methods: list[Method]) -> Iterator[Frame]:
    """The frames asked for.

    Raises `ValueError` where a network was made for another grid, or a map or its truth is not finite.
    """
    for method in methods:
        if method.grid is not None and method.grid != data.grid:
            raise ValueError(
                f"{data.directory}: grid must be that of method {method.name}'s card, {method.grid}, got {data.grid}"
            )
    for frame in data.frames(indices):
        values = frame.ra_map.values
        if not np.isfinite(values).all():
            count = np.count_nonzero(~np.isfinite(values))
            raise ValueError(f"{data.directory}: frame {frame.index}: map must be finite, {count} cells are not")
        yield frame


def run_methods(methods: list[Method], frames: Iterable[Frame], tick: Tick = lambda: None) -> Run:
    """Every method on every frame, one after the other on the same frame so that all share the machine's moods."""
    runs = [MethodRun(method) for method in methods]
    truth: list[FrameTruth] = []
    indices: list[int] = []
    for frame in frames:
        if not indices:
            # the first call of anything compiles, allocates, reads
            for run in runs:
                run.method.place(run.method.detect(frame))
        indices.append(frame.index)
        truth.append(truth_of_labels(frame))
        for run in runs:
            _step(run, frame)
        tick()
    if not indices:
        raise ValueError("frames must hold at least one, got none")
    return Run(indices=indices, truth=truth, runs=runs)


def _step(run: MethodRun, frame: Frame) -> None:
    """One method on one frame."""
    method = run.method
    start_ns = time.perf_counter_ns()
    peaks = method.detect(frame)
    detected_ns = time.perf_counter_ns()
    scene_view = method.place(peaks)
    geometry_done_ns = time.perf_counter_ns()
    run.answers.append(answer_of(peaks, *scene_view))
    run.milliseconds.append(
        (MS_PER_S * s_from_ns(detected_ns - start_ns), MS_PER_S * s_from_ns(geometry_done_ns - detected_ns))
    )


def answer_of(peaks: Peaks, places_m: np.ndarray, hidden: np.ndarray) -> FrameAnswer:
    """Peaks and recovered places [N, 2] in metres, those of a mask [N] held for hidden."""
    points_m = xy_from_polar(peaks.range_m, peaks.azimuth_rad)
    return FrameAnswer(points_m=points_m, path_class=peaks.path_class, recovered_m=places_m, hidden_m=places_m[hidden])


def truth_of_labels(frame: Frame) -> FrameTruth:
    """The truth a data set holds of a frame; raises `ValueError` where the true place of an image is missing."""
    labels = frame.labels
    points = np.asarray(xy_from_polar(labels.range_m, labels.azimuth_rad), np.float64)
    if frame.places_m is not None:
        places_m = frame.places_m.astype(np.float64)
        return FrameTruth(points_m=points, path_class=labels.path_class, places_m=places_m, hidden_m=places_m)
    if not np.isfinite(labels.hidden_xy_m[labels.path_class == PathClass.MIRRORED]).all():
        raise ValueError(f"frame {frame.index}: hidden_xy_m of mirrored points must be finite")
    # where no object is known, everything mirrored counts as hidden
    return truth_of_points(labels, points, frame.hidden if frame.objects else None)


def truth_of_points(labels: FrameLabels | Labels, points_m: np.ndarray, hidden: Sequence[int] | None) -> FrameTruth:
    """Truth from labels at [N, 2]; `hidden` are the objects that mirrors alone show, None: all that is mirrored."""
    mirrored = labels.path_class == PathClass.MIRRORED
    alone = mirrored if hidden is None else mirrored & np.isin(labels.object_index, hidden)
    return FrameTruth(
        points_m=np.asarray(points_m, np.float64),
        path_class=labels.path_class,
        places_m=labels.hidden_xy_m[mirrored].astype(np.float64),
        hidden_m=labels.hidden_xy_m[alone].astype(np.float64),
    )
