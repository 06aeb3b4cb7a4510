"""Hidden objects from detections of a simulated radar that gives no beats.

Every path of a random place (all effects, the default radar) that is over the threshold is a detection, with the errors
of a sensor; no class, no map, no network. Places are those of the validation sets of
`launch/evaluation/object_sets.yaml`; `DETECTION_GEOMETRY` was chosen on the first 40 at rest, its scores were fitted on
them and on those from 140: both are left out unless `--first` asks for them.
Usage: python -m benchmarks.perception.simulated_detections [--first N] [--places 100] [--moving] [--json FILE]
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from mirrorwave.studies.evaluate.objects import ObjectSet, read_sets
from models.evaluation.object_rows import ImageTruth, ScanRow, is_false, scan_row
from models.perception.detections.defaults import DETECTION_GEOMETRY
from models.perception.detections.sensor import DetectionSensor
from models.perception.detections.stage import DetectionsStage
from models.perception.geometry.stage import GeometryParams, recover_bev
from msgs.values.detections import RadarDetections
from msgs.values.radar import RadarSetup
from sim_player.effects.table import ALL_EFFECTS
from sim_player.scene.world import prepare
from sim_player.trace.paths import Paths
from sim_player.trace.ray_tracing import trace
from sim_player.trace.truth import best_power_mw, object_images, scene_truth

SENSOR = DetectionSensor(threshold_db=15.0)
MIN_RANGE_M = 0.5
#: Places at rest on which the parameters were chosen.
CHOSEN_ON = 40


def detections_of(setup: RadarSetup, paths: Paths, sensor: DetectionSensor, seed: list[int]) -> RadarDetections:
    """Return the paths over the sensor's threshold in its field as detections with its errors; radial speeds are
    relative to the radar.
    """
    noise_mw = setup.radar.noise_power_mw / (setup.radar.samples_per_chirp * setup.radar.chirps_per_beam)
    snr_db = 10.0 * np.log10(np.maximum(best_power_mw(setup, paths) / noise_mw, 1e-30))
    range_m = 0.5 * paths.length_m
    inside = (range_m > MIN_RANGE_M) & (range_m < sensor.max_range_m) & (snr_db > sensor.threshold_db)
    inside &= np.abs(paths.azimuth_rad) < np.radians(sensor.azimuth_limit_deg)
    kept = np.flatnonzero(inside)
    rng = np.random.default_rng(seed)
    errors = rng.standard_normal((4, len(kept)))
    range_std_m, azimuth_std_rad = sensor.range_std_m, np.radians(sensor.azimuth_std_deg)
    return RadarDetections(
        stamp_ns=0,
        scan_id=0,
        range_m=range_m[kept] + range_std_m * errors[0],
        azimuth_rad=paths.azimuth_rad[kept] + azimuth_std_rad * errors[1],
        covariance=np.tile(np.diag([range_std_m**2, azimuth_std_rad**2]), (len(kept), 1, 1)),
        elevation_rad=paths.elevation_rad[kept] + np.radians(sensor.elevation_std_deg) * errors[3],
        radial_speed_mps=paths.radial_speed_mps[kept] + sensor.speed_std_mps * errors[2],
        snr_db=snr_db[kept],
    )


def measured(
    places: ObjectSet, index: int, sensor: DetectionSensor, variants: dict[str, GeometryParams]
) -> dict[str, tuple[ScanRow, float]]:
    """Return the row and the seconds of one place for each set of parameters."""
    place = places.place(index)
    world = prepare(place.scene, places.seed + index, place.scene.setup)
    setup, paths = place.scene.setup, trace(world, 0.0, ALL_EFFECTS)
    detections = detections_of(setup, paths, sensor, [places.seed, index, 7])
    truth, images = scene_truth(world, setup, paths, 0.0, 0, 0), object_images(setup, paths, len(place.scene.objects))
    visible = [
        ImageTruth(direct=bool(direct), mirrored=bool(mirrored), snr_db=None, single_snr_db=None)
        for direct, mirrored in zip(images.direct, images.mirrored, strict=True)
    ]
    rows = {}
    for name, params in variants.items():
        stage = DetectionsStage(sensor, params)
        start_s = time.perf_counter()
        frame = recover_bev(stage.peaks(detections), params)
        rows[name] = scan_row(index, frame.objects, truth, visible), time.perf_counter() - start_s
    return rows


def summary(rows: list[tuple[ScanRow, float]]) -> dict[str, Any]:
    """Return recall of objects with an image, false reports a scan and the median time."""
    hidden = [item for row, _ in rows for item in row.hidden if item.image.mirrored]
    reports = [item for row, _ in rows for item in row.reports]
    return {
        "scans": len(rows),
        "hidden": len(hidden),
        "matched": sum(item.error_m is not None for item in hidden),
        "reports": len(reports),
        "false_per_scan": sum(is_false(item) for item in reports) / max(len(rows), 1),
        "median_ms": 1e3 * float(np.median([seconds for _, seconds in rows])),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.perception.simulated_detections", description=__doc__)
    parser.add_argument("--first", type=int, help="number of the first place (40 at rest, 0 moving)")
    parser.add_argument("--places", type=int, default=100)
    parser.add_argument("--moving", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    places = read_sets().sets["validation_moving" if options.moving else "validation"]
    variants = {
        "default": DETECTION_GEOMETRY,
        "what nothing hides counts": _open_view_counts(),
        "geometry of maps": GeometryParams(),
    }
    first = (0 if options.moving else CHOSEN_ON) if options.first is None else options.first
    indices = range(first, min(first + options.places, places.places))
    results = [measured(places, index, SENSOR, variants) for index in indices]
    table = {name: summary([result[name] for result in results]) for name in variants}
    for name, row in table.items():
        print(name, " ".join(f"{key}={value:.3g}" for key, value in row.items()))
    if options.json:
        options.json.write_bytes(msgspec.json.format(msgspec.json.encode(table)))


def _open_view_counts() -> GeometryParams:
    """Return the parameters without the rule that what nothing hides is no hidden object."""
    recovery = msgspec.structs.replace(DETECTION_GEOMETRY.recovery, reject_in_open_view=False)
    return msgspec.structs.replace(DETECTION_GEOMETRY, recovery=recovery)


if __name__ == "__main__":
    main()
