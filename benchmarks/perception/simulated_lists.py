"""Hidden objects in target lists of drawn places.

    python -m benchmarks.perception.simulated_lists [--seed S] [--places N] [--scans K]

Every path of a place (all effects, the default radar) over the sensor's threshold is a detection, with the sensor's
errors and no class. Scans after the first are of a drive. Printed are how many objects a mirror shows, how many have a
mirrored detection (the most that any stage can find) and a wall that leads to them, and what is found, and how much
falsely a scan, by clusters of folded returns and as judged.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from lab.evaluate.labelled_beams import LabelledPlace
from lab.evaluate.place_runs import image_truth
from lab.measures.object_rows import ImageTruth, ScanRow, is_false, scan_row
from models.perception.mirrors.mirror_table import WallArrays, wall_arrays
from models.perception.see.evidence_predictor import EvidencePredictor
from models.perception.target_lists.defaults import DETECTION_GEOMETRY
from models.perception.target_lists.sensor import DetectionSensor
from models.perception.target_lists.targets_to_peaks import DetectionsStage
from models.perception.track.views_over_scans import ViewStage
from models.physics.mirror import reflect
from msgs.values.detections import RadarDetections
from msgs.values.perception import PathClass, Peaks, SceneTruth
from msgs.values.radar import RadarSetup
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState
from sim_player.paths.truth import best_power_mw, labelled
from sim_player.trace.path_table import Paths

SENSOR = DetectionSensor(threshold_db=15.0)
#: A folded detection this near to where it came from was folded by the right wall.
LED_M = 1.5


def listed(setup: RadarSetup, paths: Paths) -> np.ndarray:
    """Return the indices of the paths that the sensor detects."""
    noise_mw = setup.radar.noise_power_mw / (setup.radar.samples_per_chirp * setup.radar.chirps_per_beam)
    loud = best_power_mw(setup, paths) > noise_mw * 10.0 ** (0.1 * SENSOR.threshold_db)
    near = (paths.length_m > 1.0) & (paths.length_m < 2.0 * SENSOR.max_range_m)
    return np.flatnonzero(loud & near & (np.abs(paths.azimuth_rad) < np.radians(SENSOR.azimuth_limit_deg)))


def detections_of(setup: RadarSetup, paths: Paths, stamp_ns: int, scan_id: int, seed: list[int]) -> RadarDetections:
    """Return detected paths as a list with the sensor's errors; radial speeds are relative to the radar."""
    noise_mw = setup.radar.noise_power_mw / (setup.radar.samples_per_chirp * setup.radar.chirps_per_beam)
    errors = np.random.default_rng(seed).standard_normal((4, len(paths.length_m)))
    std = np.array([SENSOR.range_std_m, np.radians(SENSOR.azimuth_std_deg)])
    return RadarDetections(
        stamp_ns=stamp_ns,
        scan_id=scan_id,
        range_m=0.5 * paths.length_m + std[0] * errors[0],
        azimuth_rad=paths.azimuth_rad + std[1] * errors[1],
        covariance=np.tile(np.diag(std**2), (len(paths.length_m), 1, 1)),
        elevation_rad=paths.elevation_rad + np.radians(SENSOR.elevation_std_deg) * errors[3],
        radial_speed_mps=paths.radial_speed_mps + SENSOR.speed_std_mps * errors[2],
        snr_db=10.0 * np.log10(best_power_mw(setup, paths) / noise_mw),
    )


class ListedScan(NamedTuple):
    """A scan of a place: the paths that are detected, the peaks of their list, what is true."""

    paths: Paths
    peaks: Peaks
    truth: SceneTruth
    images: list[ImageTruth]
    state: VehicleState


def listed_scans(place: LabelledPlace) -> Iterator[ListedScan]:
    """Yield the scans of a place or a drive."""
    player, stage = place.player, DetectionsStage(SENSOR, DETECTION_GEOMETRY)
    for scan in range(place.scans):
        stamp_ns = player.stamp_ns(scan)
        paths = player.paths(s_from_ns(stamp_ns - player.setup.stamp_ns))
        paths = paths.take(listed(player.setup, paths))
        state = player.vehicle_state(stamp_ns)
        stage.add_state(state)
        seed = [place.seed, place.index, scan, 7]
        peaks = stage.peaks(detections_of(player.setup, paths, stamp_ns, scan, seed))
        yield ListedScan(paths, peaks, player.truth(scan), image_truth(player, scan), state)


def print_found(name: str, rows: list[ScanRow]) -> None:
    """Print recall and false reports."""
    hidden = [item for row in rows for item in row.hidden if item.image.mirrored]
    found = sum(item.error_m is not None for item in hidden)
    false = sum(is_false(item) for row in rows for item in row.reports) / len(rows)
    print(f"{name}: {found} of {len(hidden)} ({found / max(len(hidden), 1):.2f}), {false:.2f} false a scan", flush=True)


def led(own: Paths, walls: WallArrays) -> bool:
    """Return whether a wall folds some mirrored path to where it came from."""
    folded = (reflect(own.virtual_m[:, :2], walls.normal[at], walls.offset_m[at]) for at in range(len(walls)))
    return any(bool((np.hypot(*(at_m - own.point_m[:, :2]).T) < LED_M).any()) for at_m in folded)


def main() -> None:
    """Print the funnel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=48002)
    parser.add_argument("--places", type=int, default=100)
    parser.add_argument("--scans", type=int, default=1)
    options = parser.parse_args()
    predictor, counts = EvidencePredictor(), [0, 0]
    rows: dict[str, list[ScanRow]] = {"clusters": [], "judged": []}
    for index in range(options.places):
        views = {
            name: ViewStage(predictor=predictor if name == "judged" else None, detections=DETECTION_GEOMETRY)
            for name in rows
        }
        for scan in listed_scans(LabelledPlace(options.seed, index, "all", scans=options.scans)):
            for name, view in views.items():
                view.add_state(scan.state)
                frame = view.view(scan.peaks)
                rows[name].append(scan_row(index, frame.objects, scan.truth, scan.images))
            single = labelled(scan.paths) & (scan.paths.kind == PathClass.MIRRORED) & (scan.paths.order == 1)
            for number, image in enumerate(scan.images):
                own = scan.paths.take(np.flatnonzero(single & (scan.paths.object_index == number)))
                if image.mirrored and not image.direct and len(own.length_m):
                    counts[0] += 1
                    counts[1] += led(own, wall_arrays(list(frame.walls)))
    for name in rows:
        print_found(name, rows[name])
    print(f"with a mirrored detection of one bounce {counts[0]}, led to by a fitted wall {counts[1]}")


if __name__ == "__main__":
    main()
