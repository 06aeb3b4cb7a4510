"""The evidence network on the vehicle: one worked out by hand sees images where the mirror law puts them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.special import logit

from lab.training.export.onnx import write_card
from models.perception.cards import card_path, read_card
from models.perception.mirrors.peaks_to_view import GeometryParams, direct_structure, recover_bev
from models.perception.mirrors.peaks_to_view import synthetic_peaks as street_peaks
from models.perception.see.detections import ANSWERS, CENTRE, HEADING, OBJECT, PLACE
from models.perception.see.evidence_predictor import EvidenceCard, EvidencePredictor
from models.perception.track.views_over_scans import ViewStage
from msgs.values.perception import BevFrame, HiddenObject, Peaks, Visibility
from msgs.values.radar import NO_RADIAL_SPEED, RangeAzimuthGrid, RangeAzimuthMap
from msgs.values.vehicle import VehicleState
from tests.models.perception.see.networks_by_hand import EVIDENCE, GRID, echoes, empty_map, evidence_network, written


def synthetic_peaks() -> Peaks:
    """The made-up street as a network detects it."""
    return msgspec.structs.replace(street_peaks(), detector="sha256/pursuit")


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return evidence_network(tmp_path_factory.mktemp("network"))


#: Images behind the facade at x = 20 m.
IMAGES_M = ((27.0, -9.0), (27.0, -7.0), (28.0, -4.0))


def street_map(**values: object) -> RangeAzimuthMap:
    return empty_map(**{"values": echoes(*IMAGES_M)} | values)


def view(predictor: EvidencePredictor | None, **values: object) -> BevFrame:
    """The made-up street: a facade at x = 20 m, images at (27, -9), (27, -7) and (28, -4)."""
    return ViewStage(predictor=predictor).view(synthetic_peaks(), street_map(**values))


def near(objects: tuple[HiddenObject, ...], x_m: float, y_m: float) -> float:
    return min(float(np.hypot(item.x_m - x_m, item.y_m - y_m)) for item in objects)


def test_images_are_folded_by_the_walls_of_the_scan(network: Path) -> None:
    """(27, -9) behind x = 20 is (13, -9). Cells of half a metre see the loudest cell of five azimuths, 2.4 deg or 1.2 m
    at 28 m, and reports nearer to each other than 1.2 m are one.
    """
    objects = view(EvidencePredictor(network)).objects
    assert {item.object_class for item in objects} == {"car"}
    assert near(objects, 13.0, -9.0) < 1.2
    assert near(objects, 12.0, -4.0) < 1.2
    assert all(item.score > 0.9 for item in objects)


def test_a_vehicle_in_motion_has_its_own_calibration(network: Path) -> None:
    """A hand-made network answers near 1, which the table in motion calls 0.8: from 0.7 on, all stay."""
    card = read_card(card_path(network), EvidenceCard)
    moving = msgspec.structs.replace(card, calibration_moving=((0.0, 0.0), (0.9, 0.8), (1.0, 0.81)))
    assert card.calibration_of(moving=True) == moving.calibration_of(moving=False) == ()
    assert moving.calibration_of(moving=True) == moving.calibration_moving
    write_card(moving, network)
    try:
        predictor = EvidencePredictor(network)
    finally:
        write_card(card, network)
    scores = {}
    for speed_mps in (None, 0.0, 0.4, -3.0, 8.0):
        stage = ViewStage(predictor=predictor)
        if speed_mps is not None:
            stage.add_state(VehicleState(stamp_ns=0, speed_mps=speed_mps))
        scores[speed_mps] = [item.score for item in stage.view(synthetic_peaks(), street_map()).objects]
    assert all(len(said) == len(scores[None]) > 0 for said in scores.values())
    for speed_mps in (None, 0.0, 0.4):
        assert min(scores[speed_mps]) > 0.9
    for speed_mps in (-3.0, 8.0):
        assert all(0.7 < score <= 0.81 for score in scores[speed_mps])


def test_without_map_or_for_another_sensor_the_places_are_clustered(network: Path) -> None:
    """A LiDAR's map, a grid of other range bins, no map at all, no network: the same objects each time."""
    predictor = EvidencePredictor(network)
    plain = recover_bev(synthetic_peaks(), GeometryParams()).objects
    assert plain != view(predictor).objects
    assert view(None).objects == plain
    assert view(predictor, mode="photons").objects == plain
    assert view(predictor, grid=RangeAzimuthGrid(range_bin_m=0.1)).objects == plain
    assert ViewStage(predictor=predictor).view(synthetic_peaks()).objects == plain
    # peaks of CFAR: the network was trained on another detector's
    assert ViewStage(predictor=predictor).view(street_peaks(), street_map()).objects == plain


def test_a_map_that_does_not_suit_is_refused(network: Path) -> None:
    _, walls = direct_structure(synthetic_peaks(), GeometryParams())
    with pytest.raises(ValueError, match=r"map\.mode must be of a radar for by_hand, got photons"):
        EvidencePredictor(network).judge(street_map(mode="photons"), walls)


def test_a_score_heeds_the_views_mask(network: Path) -> None:
    """A logit more where a mirror shows its place; in direct sight it falls below the threshold."""
    card = msgspec.structs.replace(read_card(card_path(network), EvidenceCard), visibility_logits=(0.0, -20.0, 1.0))
    write_card(card, network)
    grid, (_, walls) = GeometryParams().grid, direct_structure(synthetic_peaks(), GeometryParams())
    begun = EvidencePredictor(network, threshold=0.2).judge(street_map(), walls)
    masks = {state: np.full((grid.rows, grid.columns), state, np.uint8) for state in Visibility}
    plain = begun()
    assert begun(masks[Visibility.UNKNOWN], grid) == plain
    assert begun(masks[Visibility.DIRECT], grid) == ()
    shown = logit([item.score for item in begun(masks[Visibility.MIRRORED], grid)])
    np.testing.assert_allclose(shown, logit([item.score for item in plain]) + 1.0)


def test_scans_are_judged_beside_each_other(network: Path) -> None:
    """A scan that waits for its objects gets its own, whatever was begun meanwhile, as often as it asks."""
    predictor, (_, walls) = EvidencePredictor(network), direct_structure(synthetic_peaks(), GeometryParams())
    maps = street_map(), street_map(values=echoes((30.0, 2.0)))
    alone = [predictor.judge(ra_map, walls)() for ra_map in maps]
    begun = [predictor.judge(ra_map, walls) for ra_map in maps]
    assert [objects() for objects in reversed(begun)] == alone[::-1]
    assert begun[0]() == alone[0] != alone[1]


def test_a_map_whose_peaks_are_awaited_is_answered_once(network: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The field network begins with the map; another map, and one that does not suit, are answered as without it."""
    predictor, (_, walls) = EvidencePredictor(network), direct_structure(synthetic_peaks(), GeometryParams())
    maps = street_map(), street_map(values=echoes((30.0, 2.0)))
    alone = [predictor.judge(ra_map, walls)() for ra_map in maps]
    answered: list[RangeAzimuthMap] = []
    answer = predictor._fields.answer

    def counted(ra_map: RangeAzimuthMap) -> np.ndarray:
        answered.append(ra_map)
        return answer(ra_map)

    monkeypatch.setattr(predictor._fields, "answer", counted)
    predictor.expect(maps[0])
    predictor.expect(street_map(mode="photons"))
    assert [predictor.judge(ra_map, walls)() for ra_map in maps] == alone
    assert [id(ra_map) for ra_map in answered] == [id(ra_map) for ra_map in maps]


def test_what_fails_beside_the_scan_is_raised_where_it_waits(network: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = EvidencePredictor(network)

    def fail(cells: np.ndarray) -> np.ndarray:
        raise ValueError("answers must be finite")

    monkeypatch.setattr(predictor, "answer", fail)
    _, walls = direct_structure(synthetic_peaks(), GeometryParams())
    begun = predictor.judge(street_map(), walls)
    with pytest.raises(ValueError, match="answers must be finite"):
        begun()
    # the next scan is judged again
    monkeypatch.undo()
    assert ViewStage(predictor=predictor).view(synthetic_peaks(), street_map()).objects


def test_objects_have_the_time_of_their_own_column(network: Path) -> None:
    """Columns are 120 / 255 degrees and a millisecond apart, from -60 degrees on; the image at (28, -4) is three
    columns wide at most.
    """
    objects = view(EvidencePredictor(network)).objects
    item = min(objects, key=lambda one: float(np.hypot(one.x_m - 12.0, one.y_m + 4.0)))
    assert 1e-6 * item.stamp_ns == pytest.approx(float(GRID.azimuth_index(np.arctan2(-4.0, 28.0))), abs=3.0)


def moving_map(cell_speed_mps: float, **values: Any) -> RangeAzimuthMap:
    """The street's map, of 40 dB of SNR, whose every cell moves at one radial speed."""
    still = empty_map(ego_compensated=True, **values)
    speed = np.full(still.grid.shape, NO_RADIAL_SPEED if np.isnan(cell_speed_mps) else 100 * cell_speed_mps, np.int16)
    return msgspec.structs.replace(
        still, values=echoes(*IMAGES_M, snr_db=40.0), radial_speed_cmps=speed, radial_speed_unit_std_mps=80.0
    )


def test_an_objects_radial_speed_is_along_the_ray_that_the_wall_turns(network: Path) -> None:
    """An image at (27, -9) that goes away at 2 m/s: behind x = 20 the ray (27, -9) goes on as (-27, -9), along which
    the object at (13, -9) moves. Directions within 4 deg (cells of half a metre, and the wall's error); 80 m/s at an
    SNR of 1 is 0.8 at 40 dB.
    """
    objects = ViewStage(predictor=EvidencePredictor(network)).view(synthetic_peaks(), moving_map(2.0)).objects
    item = min(objects, key=lambda one: float(np.hypot(one.x_m - 13.0, one.y_m + 9.0)))
    assert item.radial_speed is not None
    assert item.radial_speed.speed_mps == 2.0
    assert item.radial_speed.std_mps == pytest.approx(0.8, rel=1e-3)
    assert np.degrees(item.radial_speed.azimuth_rad) == pytest.approx(np.degrees(np.arctan2(-9.0, -27.0)), abs=4.0)


def test_no_radial_speed_is_said_in_noise_or_of_a_map_from_an_unknown_motion(network: Path) -> None:
    stage = ViewStage(predictor=EvidencePredictor(network))
    silent = stage.view(synthetic_peaks(), moving_map(np.nan)).objects
    unknown = stage.view(synthetic_peaks(), msgspec.structs.replace(moving_map(2.0), ego_compensated=False)).objects
    assert silent
    assert unknown
    assert all(item.radial_speed is None for item in (*silent, *unknown))


def test_left_and_right_are_alike(network: Path, tmp_path: Path) -> None:
    """Cells and their mirror image: answers of the other side, across with the other sign. Random weights."""
    import torch

    from lab.networks.evidence_unet import EvidenceUNet

    torch.manual_seed(0)
    unet = EvidenceUNet(EVIDENCE.shape[0], ANSWERS).eval()
    path = written(tmp_path, unet, "random")
    channels = np.random.default_rng(0).normal(size=EVIDENCE.shape).astype(np.float32)
    flipped = channels[..., ::-1].copy()
    flipped[EVIDENCE.odd_channels] *= -1.0
    for flip_test in (True, False):
        predictor = EvidencePredictor(path, flip_test=flip_test)
        here, there = (predictor.answer(item) for item in (channels, flipped))
        turned = there[..., ::-1].copy()
        turned[[PLACE.start + 1, HEADING.start + 1, CENTRE.start + 1]] *= -1.0
        np.testing.assert_allclose(here, turned, atol=1e-4)


def test_what_does_not_belong_together_is_refused_in_a_line(network: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nothing\.json"):
        EvidencePredictor(tmp_path / "nothing.onnx")
    with pytest.raises(ValueError, match=r"threshold must lie in 0\.\.1, got 1\.5"):
        EvidencePredictor(network, threshold=1.5)
    with pytest.raises(ValueError, match="threads must be at least 1"):
        EvidencePredictor(network, threads=0)
    path = tmp_path / "cut.onnx"
    path.write_bytes(network.read_bytes()[:-20])
    for own in (network.with_name("fields.onnx"), network.with_name("fields.json")):
        (tmp_path / own.name).write_bytes(own.read_bytes())
    card_path(path).write_bytes(card_path(network).read_bytes())
    with pytest.raises(ValueError, match="sha256 must be"):
        EvidencePredictor(path)
    card = msgspec.json.decode(card_path(network).read_bytes())
    card_path(path).write_bytes(msgspec.json.encode(card | {"output_shape": [1, 2, 3, 4]}))
    with pytest.raises(ValueError, match=r"card\.output_shape must be"):
        EvidencePredictor(path)


def test_answers_that_are_no_numbers_are_refused(network: Path, tmp_path: Path) -> None:
    """Weights of infinity make NaN of zeros: known at start, not at the first scan."""
    with pytest.raises(ValueError, match="answers must be finite"):
        EvidencePredictor(evidence_network(tmp_path, gain=float("inf")))


@pytest.mark.parametrize(("threshold", "reported"), [(0.46, True), (0.47, False)])
def test_the_threshold_is_a_calibrated_probability(
    network: Path, monkeypatch: pytest.MonkeyPatch, threshold: float, reported: bool
) -> None:
    """Answers of 0.7 that the table calls 0.7 / 0.9 * 0.6 = 0.467."""
    card = read_card(card_path(network), EvidenceCard)
    write_card(msgspec.structs.replace(card, calibration=((0.0, 0.0), (0.9, 0.6), (1.0, 0.61))), network)
    try:
        predictor = EvidencePredictor(network, threshold=threshold)
    finally:
        write_card(card, network)

    def unsure(channels: np.ndarray) -> np.ndarray:
        said = answer(channels)
        said[OBJECT] = np.minimum(said[OBJECT], logit(0.7))
        return said

    answer = predictor.answer
    monkeypatch.setattr(predictor, "answer", unsure)
    scores = [item.score for item in view(predictor).objects]
    assert scores == ([pytest.approx(0.7 / 0.9 * 0.6, abs=1e-5)] * len(scores) if reported else [])
    assert bool(scores) == reported
