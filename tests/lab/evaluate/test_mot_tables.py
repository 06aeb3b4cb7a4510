"""Objects and tracks of drives as MOT text."""

from __future__ import annotations

from pathlib import Path

from lab.evaluate.mot_tables import write_mot_tables
from lab.measures.object_rows import HiddenRow, ImageTruth, ScanRow, TrackRow


def hidden(object_id: int, mirrored: bool) -> HiddenRow:
    image = ImageTruth(direct=False, mirrored=mirrored, snr_db=None, single_snr_db=None)
    return HiddenRow(
        object_class="car", image=image, at_m=(1.5, -2.0), error_m=None, centre_m=None, found_by_centre=False,
        object_id=object_id,
    )  # fmt: skip


def test_rows_say_frame_id_and_centre_of_what_is_scored(tmp_path: Path) -> None:
    track = TrackRow(id=7, at_m=(1.0, 0.25), error_m=None, box_m=None)
    scans = [
        ScanRow(place=2, scan=40, hidden=[hidden(3, True), hidden(4, False)], reports=[]),
        ScanRow(place=2, scan=41, hidden=[], reports=[], tracks=[track]),
    ]
    write_mot_tables(tmp_path, {"launch/profiles/mine.yaml": scans})
    assert (tmp_path / "truth/00002/gt/gt.txt").read_text() == "1,3,-1,-1,-1,-1,1,1.500000,-2.000000,0\n"
    assert (tmp_path / "mine/00002.txt").read_text() == "2,7,-1,-1,-1,-1,1,1.000000,0.250000,0\n"
