"""The chain as it runs, in single precision, against the same chain in double precision; and one thread against two.

Random labelled places (`lab.evaluate.labelled_beams`, every effect the place calls for), the default profile.
Single: `RaFormer`, `NetworkDetector`, `fold_scan` as the nodes call them. Double: the same formulas written out in
float64 and complex128 from the integer sums on (transform, window, Doppler, co-array by least squares on the stacked
system instead of normal equations, encoding, every operator of the network, pursuit, peaks), geometry as it is, for it
is float64. A place is the same one in both where its image has the same class and stands within a metre, one to one.
What only one run has is told apart: `threshold`, the image's peak is missing in the other run, with how far its score
is from the threshold; `wall`, the peak is in both and the folding decided otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numba
import numpy as np
import onnx
import scipy
from onnx import TensorProto, numpy_helper
from onnx.reference import ReferenceEvaluator
from onnx.reference.op_run import OpRun
from scipy.special import gammainccinv
from threadpoolctl import threadpool_limits

from lab.measures.point_scores import match_points
from models.perception.find.detectors import NetworkDetector
from models.perception.find.encoding import Encoding, sample_columns
from models.perception.find.onnx_model import DEFAULT_MODEL, DensePredictor, load_card
from models.perception.find.peaks import PeakParams, find_pursued_peaks
from models.perception.form.coarray import NOISE_FALSE_ALARM, AzimuthInterpolator, beam_matrix, ideal_beams
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import DOPPLER_EXCESS_DB, DOPPLER_LIMIT_MPS, DOPPLER_SNR_DB, FormingParams
from models.perception.form.slow_time_sums import fold_chirps, group_edges
from models.perception.mirrors.peaks_to_view import FoldedScan, GeometryParams, fold_scan, recover_bev
from msgs.bus.codec import encode_inline
from msgs.values.frames import xy_from_polar
from msgs.values.perception import BevFrame, PathClass, Peaks
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthGrid, RangeAzimuthMap, amplitude_per_code
from msgs.values.units import ratio_from_db

#: Ridge and taps of the chain, for a complete scan.
RIDGE, HANN = 1e-7, (-0.5, 1.0, -0.5)
#: Images of one class this near each other are the same one; a recovered place that moves more than this has changed.
SAME_M, AIM_M = 1.0, 0.01


class DoubleChain:
    """Scan -> folded places with every number in float64 or complex128, for complete scans without ego motion."""

    def __init__(self, setup: RadarSetup) -> None:
        self.setup, self.params, self.grid = setup, FormingParams(), RangeAzimuthGrid()
        self.card = load_card(DEFAULT_MODEL)
        self.threshold = self.card.threshold_for("pursuit")
        self._network = double_network()
        beams = beam_matrix(setup)
        self._back = ridge_back(beams)
        self._steering = ideal_beams(setup, self.grid.azimuth_rad)
        self._residual = np.eye(len(beams)) - beams @ self._back
        self._model_error = AzimuthInterpolator(setup, self.grid).model_error
        self._magnitude = ideal_beams(setup, setup.beams.azimuth_rad)

    def map(self, beams: list[RadarBeam], stamps: RangeAzimuthMap) -> SimpleNamespace:
        """What `RangeAzimuthMap` holds, values complex128; `stamps` lends what is no measurement.

        Raises `ValueError` where the chain left beams out: their co-array is another one.
        """
        if stamps.missing_beams:
            raise ValueError(f"a scan must be complete, got one without beams {stamps.missing_beams}")
        profiles, noise_mw = map(np.array, zip(*(self._profile(beam) for beam in beams), strict=True))
        beam_noise_mw = float(np.median(noise_mw))
        forward = self._steering @ self._back
        values = (forward @ profiles).T
        incoherent = self._incoherent(profiles, beam_noise_mw)
        magnitude = self._steering @ ridge_back(self._magnitude) @ np.abs(profiles[:, incoherent])
        values[incoherent] = np.maximum(magnitude.real, 0.0).T
        return SimpleNamespace(
            stamp_ns=stamps.stamp_ns,
            scan_id=stamps.scan_id,
            mode=stamps.mode,
            grid=self.grid,
            values=values,
            azimuth_stamp_ns=stamps.azimuth_stamp_ns,
            noise_power_mw=beam_noise_mw * float(np.sum(np.abs(forward) ** 2) / len(forward)),
            incoherent=incoherent,
            settled_stamp_ns=None,
            ego_compensated=stamps.ego_compensated,
            missing_beams=(),
            saturated_share=stamps.saturated_share,
            faults=stamps.faults,
            vehicle_from_radar=stamps.vehicle_from_radar,
            radial_speed_cmps=None,
        )

    def heatmap(self, double_map: SimpleNamespace) -> np.ndarray:
        """Probabilities float64 [2, range, azimuth]."""
        encoded = encode_double(self.card.encoding, double_map.values, double_map.noise_power_mw)
        turned = self.card.encoding.is_turned(encoded)
        if turned:
            encoded = encode_double(self.card.encoding, double_map.values[:, ::-1], double_map.noise_power_mw)
        seen = self._network.run(None, {"encoded": encoded[None]})[0][0]
        seen = seen[..., ::-1] if turned else seen
        assert seen.dtype == np.float64
        whole = np.zeros((len(PathClass), *self.grid.shape))
        whole[:, : seen.shape[1]] = seen
        return whole

    def peaks(self, heatmap: np.ndarray, double_map: SimpleNamespace) -> Peaks:
        """Peaks by pursuit."""
        return find_pursued_peaks(heatmap, double_map, PeakParams(threshold=self.threshold))  # type: ignore[arg-type]

    def _profile(self, beam: RadarBeam) -> tuple[np.ndarray, float]:
        """Range profile complex128 [range] of a beam and its noise power per bin in milliwatt."""
        radar, params, bins = self.setup.radar, self.params, self.grid.range_bins
        groups = params.slow_time_sums or radar.chirps_per_beam
        # integers: exact in any precision that holds them
        sums, _ = fold_chirps(beam.samples, groups)
        spectra = scipy.fft.fft(sums[..., 0] + 1j * sums[..., 1], axis=1)
        spectra *= amplitude_per_code(beam.full_scale_dbm) / (radar.samples_per_chirp * radar.chirps_per_beam)
        beyond = radar.samples_per_chirp - 2 * bins
        guard = min(bins, beyond // 4)
        noise = np.abs(hann(spectra.sum(axis=0), bins + guard, beyond - 2 * guard)) ** 2
        noise_mw = float(np.median(noise) / np.log(2.0))
        doppler = self._doppler(groups) @ hann(spectra, 0, bins)
        power = np.abs(doppler) ** 2
        best = power.argmax(axis=0)
        top = power.max(axis=0)
        best[top <= ratio_from_db(DOPPLER_EXCESS_DB) * power[0]] = 0
        best[top <= ratio_from_db(DOPPLER_SNR_DB) * noise_mw] = 0
        return doppler[best, np.arange(bins)], noise_mw

    def _doppler(self, groups: int) -> np.ndarray:
        """Slow-time transform about the beam's middle, zero first; complex128 [Doppler, groups]."""
        radar, params = self.setup.radar, self.params
        edges = group_edges(radar.chirps_per_beam, groups)
        time_s = (0.5 * (edges[1:] + edges[:-1]) - 0.5 * radar.chirps_per_beam) * radar.chirp_period_s
        step_hz = 1.0 / (params.doppler_padding * radar.beam_duration_s)
        limit = int(2.0 * DOPPLER_LIMIT_MPS / radar.wavelength_m / step_hz)
        limit = min(limit, (groups - 1) * params.doppler_padding // 2)
        bins = np.concatenate([np.arange(limit + 1), -np.arange(1, limit + 1)])
        return np.exp(-2j * np.pi * step_hz * np.multiply.outer(bins, time_s))

    def _incoherent(self, profiles: np.ndarray, noise_mw: float) -> np.ndarray:
        """Bins [range] that do not fit one coherent scene."""
        left_over = np.sum(np.abs(self._residual @ profiles) ** 2, axis=0)
        limit = noise_mw * gammainccinv(np.sum(np.abs(self._residual) ** 2), NOISE_FALSE_ALARM)
        return np.asarray((left_over > limit) & (left_over > self._model_error * np.sum(np.abs(profiles) ** 2, axis=0)))


def hann(spectra: np.ndarray, first: int, count: int) -> np.ndarray:
    """Bins of unwindowed spectra [..., bins] under a Hann window of unit coherent gain."""
    bins = np.arange(first, first + count)
    return sum(tap * spectra[..., (bins + lag) % spectra.shape[-1]] for lag, tap in zip((-1, 0, 1), HANN, strict=True))


def ridge_back(beams: np.ndarray) -> np.ndarray:
    """Beams to co-array coefficients [2N-1, beams]: least squares on the system stacked over its ridge."""
    rows, columns = beams.shape
    ridge = np.sqrt(RIDGE) * np.linalg.norm(beams, 2) * np.eye(columns)
    right = np.concatenate([np.eye(rows), np.zeros((columns, rows))])
    return np.linalg.lstsq(np.concatenate([beams, ridge]), right, rcond=None)[0]


def encode_double(encoding: Encoding, values: np.ndarray, noise_mw: float) -> np.ndarray:
    """The default network's channels of a map [range, azimuth], float64 [channels, range, columns]."""
    columns = sample_columns(encoding, values)
    power_mw = np.abs(columns) ** 2
    floor_mw = max(noise_mw, power_mw.max() * 10.0 ** (-encoding.dynamic_range_db / 10.0))
    level_db = 10.0 * np.log10(np.maximum(power_mw, np.finfo(np.float64).tiny) / floor_mw)
    level = np.clip((level_db - encoding.level_min_db) / (encoding.level_max_db - encoding.level_min_db), 0.0, 1.0)
    shadow = np.zeros_like(level)
    shadow[1:] = np.maximum.accumulate(level, axis=0)[:-1]
    direction = np.exp(1j * np.angle(columns))
    rows, across = np.ones(len(level))[:, None], np.ones(encoding.columns)
    channels = {
        "level": level,
        "shadow": shadow,
        "contrast": level - level.max(axis=1, keepdims=True),
        "range": np.linspace(0.0, 1.0, encoding.range_bins)[:, None] * across,
        "azimuth": rows * np.linspace(-1.0, 1.0, encoding.columns),
        "level_real": level * direction.real,
        "level_imaginary": level * direction.imag,
    }
    return np.stack([channels[name] for name in encoding.channels])


class ConvTranspose(OpRun):
    """Upsampling whose kernels do not overlap, as one product: the reference's own takes ten times as long."""

    op_domain = ""

    def _run(self, x: np.ndarray, weight: np.ndarray, bias: np.ndarray, **how: Any) -> tuple[np.ndarray]:
        high, wide = weight.shape[2:]
        assert how["strides"] == [high, wide]
        assert how["group"] == 1
        batch, _, rows, columns = x.shape
        # [batch, rows, columns, out, high, wide]
        cells = np.tensordot(x, weight, axes=(1, 0)) + bias[:, None, None]
        spread = cells.transpose(0, 3, 1, 4, 2, 5).reshape(batch, len(bias), rows * high, columns * wide)
        return (spread,)


def double_network() -> ReferenceEvaluator:
    """The default network with its float32 weights as float64, every operator by the ONNX reference."""
    model = onnx.load(DEFAULT_MODEL)
    for tensor in model.graph.initializer:
        _widen(tensor)
    for node in model.graph.node:
        for attribute in node.attribute:
            if node.op_type == "Constant" and attribute.name == "value":
                _widen(attribute.t)
            elif node.op_type == "Cast" and attribute.i == TensorProto.FLOAT:
                attribute.i = TensorProto.DOUBLE
    for end in (*model.graph.input, *model.graph.output):
        end.type.tensor_type.elem_type = TensorProto.DOUBLE
    return ReferenceEvaluator(model, new_ops=[ConvTranspose])


def _widen(tensor: TensorProto) -> None:
    if tensor.data_type == TensorProto.FLOAT:
        wide = numpy_helper.to_array(tensor).astype(np.float64)
        tensor.CopyFrom(numpy_helper.from_array(wide, tensor.name))


@dataclass
class Answer:
    """One run on one place: its map, heat map, peaks and folded places."""

    values: np.ndarray
    heatmap: np.ndarray
    peaks: Peaks
    scan: FoldedScan


@dataclass
class Comparison:
    """How far two runs on one place are apart."""

    place: int
    #: Largest change of a cell over the largest cell, of a probability, of a peak's range.
    map_error: float
    heatmap_error: float
    #: Changes of recovered places of both [m], and of those places that count as hidden.
    moved_m: list[float]
    hidden_moved_m: list[float]
    #: What only one run has: (run, reason, distance of its score from the threshold or 0).
    alone: list[tuple[str, str, float]]
    peaks: int
    peaks_alone: int


def single(beams: list[RadarBeam], setup: RadarSetup, predictor: DensePredictor) -> tuple[Answer, RangeAzimuthMap]:
    """The chain as it runs; what the network says is asked for once more, for the comparison."""
    former = RaFormer(setup)
    (ra_map,) = [one for beam in beams for one in former.add(beam)]
    peaks = NetworkDetector(setup).detect(ra_map)
    return Answer(ra_map.values, predictor.predict(ra_map), peaks, fold_scan(peaks, GeometryParams())), ra_map


def double(beams: list[RadarBeam], chain: DoubleChain, stamps: RangeAzimuthMap) -> Answer:
    """The same in double precision."""
    double_map = chain.map(beams, stamps)
    heatmap = chain.heatmap(double_map)
    peaks = chain.peaks(heatmap, double_map)
    return Answer(double_map.values, heatmap, peaks, fold_scan(peaks, GeometryParams()))


def compare(place: int, one: Answer, two: Answer, threshold: float) -> Comparison:
    """Single against double."""
    pairs = match_points(one.scan.recovered.images_m, two.scan.recovered.images_m, SAME_M)
    moved_m = np.linalg.norm(
        one.scan.recovered.points_m[pairs[:, 0]] - two.scan.recovered.points_m[pairs[:, 1]], axis=1
    )
    hidden = one.scan.hidden[pairs[:, 0]] & two.scan.hidden[pairs[:, 1]]
    alone = [("single", *why) for why in left(one, two, pairs[:, 0], threshold)]
    alone += [("double", *why) for why in left(two, one, pairs[:, 1], threshold)]
    differ = one.scan.hidden[pairs[:, 0]] != two.scan.hidden[pairs[:, 1]]
    alone += [("both", "hidden in one", 0.0)] * int(differ.sum())
    shared = len(match_points(labelled(one.peaks), labelled(two.peaks), SAME_M))
    return Comparison(
        place=place,
        map_error=float(np.abs(one.values - two.values).max() / np.abs(two.values).max()),
        heatmap_error=float(np.abs(one.heatmap - two.heatmap).max()),
        moved_m=moved_m.tolist(),
        hidden_moved_m=moved_m[hidden].tolist(),
        alone=alone,
        peaks=len(two.peaks),
        peaks_alone=len(one.peaks) + len(two.peaks) - 2 * shared,
    )


def labelled(peaks: Peaks) -> np.ndarray:
    """Peaks in the plane with their class as a third coordinate, far apart; [N, 3]."""
    return np.column_stack([xy_from_polar(peaks.range_m, peaks.azimuth_rad), 100.0 * peaks.path_class])


def left(mine: Answer, other: Answer, matched: np.ndarray, threshold: float) -> list[tuple[str, float]]:
    """Why places of one run have none in the other."""
    found = []
    for index in np.setdiff1d(np.arange(len(mine.scan.recovered)), matched):
        image_m, score = mine.scan.recovered.images_m[index], mine.scan.recovered.score[index]
        images = other.peaks.path_class == PathClass.MIRRORED
        there = xy_from_polar(other.peaks.range_m[images], other.peaks.azimuth_rad[images])
        seen = (np.linalg.norm(there - image_m, axis=1) <= SAME_M).any()
        found.append(("wall", 0.0) if seen else ("threshold", float(score - threshold)))
    return found


def view_bytes(beams: list[RadarBeam], setup: RadarSetup, threads: int) -> bytes:
    """The view of a scan as it is recorded, computed with so many threads of network and kernels, one of BLAS."""
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        with threadpool_limits(1, "blas"):
            former, detector = RaFormer(setup), NetworkDetector(setup, threads=threads)
            (ra_map,) = [one for beam in beams for one in former.add(beam)]
            view: BevFrame = recover_bev(detector.detect(ra_map), GeometryParams())
            return encode_inline(view)
    finally:
        numba.set_num_threads(before)
