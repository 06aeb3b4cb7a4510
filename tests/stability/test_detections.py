"""Hard cases of detections of others: times as text, errors of the plane in polar form, measurement counters."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import msgspec
import numpy as np
import pytest

from contrib.boards.target_list import TargetListParams, TargetListReader
from contrib.imports.detection_columns import DetectionMapping, detections_of
from contrib.imports.detection_tables import table_scans
from nodes.can.bus import load_dbc
from tests.contrib.boards.target_radar_stand_in import measurement, random_targets
from tests.stability.catalogue import Errors

MAPPING = {
    "range": {"column": "r"}, "azimuth": {"column": "a", "unit": "deg"}, "stamp": {"column": "t"},
    "range_std": {"value": 0.1}, "azimuth_std": {"value": 0.01},
}  # fmt: skip


@pytest.mark.hard("contrib.imports.detection_tables", "seconds as a double", 0.0, "ns", "decimal digits and integers")
def test_epoch_stamps_of_tables_keep_every_nanosecond(errors: Errors, tmp_path: Path) -> None:
    """Seconds since 1970 with nine decimals: doubles lie 240 ns apart."""
    true_ns = (1_700_000_000 * 10**9 + np.arange(1000) * 50_000_003).tolist()
    rows = "\n".join(f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d},5,0" for stamp_ns in true_ns)
    path = tmp_path / "a.csv"
    path.write_text("t,r,a\n" + rows + "\n")
    mapping = msgspec.convert(MAPPING, DetectionMapping)
    read_ns = [scan.stamp_ns for scan in table_scans(path, mapping, Counter(), lambda: None)]
    naive_ns = [round(float(row.split(",")[0]) * 1e9) for row in rows.split("\n")]
    errors(
        naive=max(abs(a - b) for a, b in zip(naive_ns, true_ns, strict=True)),
        ours=max(abs(a - b) for a, b in zip(read_ns, true_ns, strict=True)),
    )


@pytest.mark.hard("contrib.imports.detection_columns", "degrees to radians alone", 1e-12, "rad",
                  "rounding of the remainder")  # fmt: skip
def test_azimuths_of_a_full_turn_come_out_around_the_front(errors: Errors) -> None:
    """A sensor that counts 0..360 deg clockwise: 350 deg are 10 deg to the left."""
    degrees = np.array([0.0, 10.0, 179.0, 181.0, 350.0, 359.999])
    azimuth = {"column": "a", "unit": "deg", "negated": True}
    mapping = msgspec.convert(MAPPING | {"azimuth": azimuth}, DetectionMapping)
    found, _ = detections_of({"r": np.full(6, 9.0), "a": degrees}, mapping, 0, 0)
    true_rad = np.angle(np.exp(-1j * np.radians(degrees)))
    errors(
        naive=float(np.abs(-np.radians(degrees) - true_rad).max()),
        ours=float(np.abs(found.azimuth_rad - true_rad).max()),
    )


@pytest.mark.hard("contrib.boards.target_list", "difference of counters as they are", 0.0, "scans", "integers")
def test_scan_numbers_go_on_at_the_counters_wrap(errors: Errors) -> None:
    """65534, 65535, 0, 2: one measurement is missing, not minus 65535."""
    counters = (65534, 65535, 0, 2)
    reader = TargetListReader(load_dbc(Path("launch/can/target_radar.dbc")), TargetListParams())
    frames = [frame for counter in counters for frame in measurement(random_targets(2, 0), counter)]
    scans = [each.scan_id for number, data in frames for each in reader.add(number, data, 0)]
    true = np.array([0, 1, 2, 4])
    naive = np.array(counters) - counters[0]
    errors(naive=float(np.abs(naive - true).max()), ours=float(np.abs(np.array(scans) - true).max()))
