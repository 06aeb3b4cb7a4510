"""SigMF captures: exact round trip, defaults, an independent capture, and one line for every fault."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import sigmf

from msgs.recording.sigmf import SigmfCapture, write_capture
from msgs.values.radar import ArrayParams, BeamGrid, ElementPattern, RadarBeam, RadarParams, RadarSetup
from tests.captures import DATA, needs

ALLEY = DATA / "sigmf_alley" / "alley.sigmf-meta"
ANGLES_DEG = (-20.0, -1.1, 17.3)
SETUP = RadarSetup(
    radar=RadarParams(chirps_per_beam=2, samples_per_chirp=16, scan_period_s=0.2),
    beams=BeamGrid(azimuth_deg=ANGLES_DEG),
    full_scale_dbm=-21.7,
)
FULL_SETUP = RadarSetup(
    stamp_ns=12345678901234567,
    radar=RadarParams(
        carrier_hz=9.7e9,
        bandwidth_hz=0.1 + 6e8,
        sample_rate_hz=1.4e9,
        chirps_per_beam=2,
        samples_per_chirp=16,
        transmit_power_w=0.1 / 3,
        noise_figure_db=7.7,
        scan_period_s=1 / 3,
    ),
    array=ArrayParams(columns=4, rows=2, column_spacing_m=0.0151, row_spacing_m=0.0149, phase_bits=0),
    element=ElementPattern(azimuth_hpbw_deg=70.0, elevation_hpbw_deg=50.0, peak_gain_dbi=5.1, sidelobe_floor_db=-30.0),
    beams=BeamGrid(azimuth_deg=ANGLES_DEG),
    full_scale_dbm=-1 / 3,
    beat_sign=-1,
    radar_height_m=0.7,
    steering_weights=np.exp(1j * np.random.default_rng(0).random((3, 4))).astype(np.complex64),
    background=(np.random.default_rng(1).random((3, 16)) * (1 - 2j)).astype(np.complex64),
)


def beams(setup: RadarSetup, count: int = 7) -> Iterator[RadarBeam]:
    random = np.random.default_rng(5)
    for at in range(count):
        yield RadarBeam(
            stamp_ns=1000 + 3 * at,
            scan_id=40 + at // 3,
            beam_index=at % 3,
            beam_count=3,
            azimuth_rad=math.radians(ANGLES_DEG[at % 3]),
            samples=random.integers(-(2**15), 2**15, (2, 16, 2), dtype=np.int16),
            full_scale_dbm=setup.full_scale_dbm,
        )


def assert_same(left: msgspec.Struct, right: msgspec.Struct) -> None:
    for name in left.__struct_fields__:
        ours, theirs = getattr(left, name), getattr(right, name)
        if isinstance(ours, np.ndarray):
            assert (ours.dtype, ours.shape, ours.tobytes()) == (theirs.dtype, theirs.shape, theirs.tobytes()), name
        else:
            assert ours == theirs, name


@pytest.mark.parametrize("setup", [SETUP, FULL_SETUP])
def test_round_trip_is_exact(tmp_path: Path, setup: RadarSetup) -> None:
    """Two scans and a partial third, every bit of setup, stamps, angles and samples."""
    write_capture(tmp_path / "c", setup, beams(setup))
    capture = SigmfCapture.open(tmp_path / "c")
    assert len(capture) == 7
    assert_same(setup, capture.setup)
    for ours, theirs in zip(beams(setup), capture.beams(), strict=True):
        assert_same(ours, theirs)


def test_any_of_three_names_opens_it(tmp_path: Path) -> None:
    for given in ("c", "c.sigmf-meta", "c.sigmf-data"):
        write_capture(tmp_path / given, SETUP, beams(SETUP), overwrite=True)
        assert len(SigmfCapture.open(tmp_path / given)) == 7
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.sigmf-data", "c.sigmf-meta"]


def test_the_sigmf_library_reads_it(tmp_path: Path) -> None:
    meta, _ = write_capture(tmp_path / "c", SETUP, beams(SETUP))
    recording = sigmf.sigmffile.fromfile(meta, autoscale=False)
    recording.validate()
    first = next(beams(SETUP)).samples.reshape(-1, 2)
    np.testing.assert_array_equal(recording.read_samples_in_capture(0), first[:, 0] + 1j * first[:, 1])


@needs(ALLEY)
def test_independent_capture_reads_with_defaults() -> None:
    capture = SigmfCapture.open(ALLEY)
    assert len(capture) == 25
    assert capture.setup.radar == RadarParams(chirps_per_beam=8)
    assert capture.setup.array == ArrayParams()
    assert capture.setup.beams == BeamGrid()
    assert capture.setup.full_scale_dbm == pytest.approx(-21.69, abs=0.005)
    assert (capture.setup.beat_sign, capture.setup.background, capture.setup.steering_weights) == (1, None, None)
    read = list(capture.beams())
    assert [(beam.scan_id, beam.beam_index) for beam in read] == [(0, index) for index in range(25)]
    # 0.3 s spread over 25 beams
    assert [beam.stamp_ns for beam in read] == [12_000_000 * index for index in range(25)]
    assert read[24].azimuth_rad == math.radians(60.0)
    data = np.fromfile(ALLEY.with_suffix(".sigmf-data"), "<i2")
    np.testing.assert_array_equal(np.concatenate([beam.samples.ravel() for beam in read]), data)


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A good capture of seven beams with changed metadata."""
    meta, _ = write_capture(folder / "c", SETUP, beams(SETUP))
    metadata = json.loads(meta.read_text())
    change(metadata)
    meta.write_text(json.dumps(metadata))
    return meta


def drop_optional(metadata: dict[str, Any]) -> None:
    for capture in metadata["captures"]:
        for key in ("stamp_ns", "scan_id", "beam_index"):
            del capture[f"mirrorwave:{key}"]
    required = ("chirp_bandwidth_hz", "chirps_per_beam", "samples_per_chirp", "beams_per_scan", "full_scale_dbm")
    for key in list(metadata["global"]):
        if key.startswith("mirrorwave:") and key.split(":")[1] not in required:
            del metadata["global"][key]


def test_absent_keys_take_their_defaults(tmp_path: Path) -> None:
    capture = SigmfCapture.open(edit(tmp_path, drop_optional))
    places = [(beam.scan_id, beam.beam_index, beam.stamp_ns) for beam in capture.beams()]
    period, interval = 300_000_000, 100_000_000
    assert places == [(at // 3, at % 3, at // 3 * period + at % 3 * interval) for at in range(7)]
    assert capture.setup.array == ArrayParams()


def test_beams_of_a_digital_array_are_of_one_time(tmp_path: Path) -> None:
    """Written, read back, and stamped alike where a capture does not say when; the flag is a truth value."""
    digital = msgspec.structs.replace(SETUP, array=ArrayParams(phase_bits=0, steered_ways=1, digital=True))
    meta_path, _ = write_capture(tmp_path / "x", digital, beams(digital, 3))
    assert SigmfCapture.open(tmp_path / "x").setup.array == digital.array
    metadata = json.loads(meta_path.read_text())
    for capture in metadata["captures"]:
        del capture["mirrorwave:stamp_ns"]
    meta_path.write_text(json.dumps(metadata))
    assert {beam.stamp_ns for beam in SigmfCapture.open(tmp_path / "x").beams()} == {0}
    metadata["global"]["mirrorwave:array_digital"] = 1
    meta_path.write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match="mirrorwave:array_digital is 1: must be true or false"):
        SigmfCapture.open(tmp_path / "x")


def test_missing_beams_of_an_only_scan_are_filled_on_the_line(tmp_path: Path) -> None:
    """Beams 0, 2 and 3 of 5, evenly spaced: the grid of the whole scan is known all the same."""
    setup = msgspec.structs.replace(SETUP, beams=BeamGrid(azimuth_deg=(-20.0, -10.0, 0.0, 10.0, 20.0)))
    taken = [
        msgspec.structs.replace(
            beam, scan_id=0, beam_index=index, beam_count=5, azimuth_rad=math.radians(setup.beams.azimuth_deg[index])
        )
        for beam, index in zip(beams(SETUP, 3), (0, 2, 3), strict=True)
    ]
    write_capture(tmp_path / "c", setup, taken)
    capture = SigmfCapture.open(tmp_path / "c")
    np.testing.assert_allclose(capture.setup.beams.azimuth_deg, setup.beams.azimuth_deg, atol=1e-12)
    assert [beam.beam_index for beam in capture.beams()] == [0, 2, 3]


FAULTS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "no datatype": (lambda m: m["global"].pop("core:datatype"), "core:datatype"),
    "other datatype": (lambda m: m["global"].update({"core:datatype": "cf32_le"}), "must be ci16_le"),
    "no sample rate": (lambda m: m["global"].pop("core:sample_rate"), "core:sample_rate is None: is required"),
    "infinite rate": (lambda m: m["global"].update({"core:sample_rate": math.inf}), "Infinity is not a JSON number"),
    "NaN level": (lambda m: m["global"].update({"mirrorwave:full_scale_dbm": math.nan}), "NaN is not a JSON number"),
    "huge level": (
        lambda m: m["global"].update({"mirrorwave:full_scale_dbm": 1e300}),
        "full_scale_dbm is 1e.300: must",
    ),
    "huge chirps": (lambda m: m["global"].update({"mirrorwave:chirps_per_beam": 10**40}), "chirps_per_beam is 1000"),
    "fraction of chirps": (lambda m: m["global"].update({"mirrorwave:chirps_per_beam": 2.5}), "whole number"),
    "no chirps": (lambda m: m["global"].update({"mirrorwave:chirps_per_beam": 0}), "chirps_per_beam is 0: must"),
    "other chirps": (lambda m: m["global"].update({"mirrorwave:chirps_per_beam": 3}), "core:sample_start is 32: must"),
    "text for number": (lambda m: m["global"].update({"mirrorwave:phase_bits": "6"}), "phase_bits is '6': must be"),
    "true for number": (lambda m: m["global"].update({"mirrorwave:phase_bits": True}), "phase_bits is True: must be"),
    "beat sign": (lambda m: m["global"].update({"mirrorwave:beat_sign": 0}), "beat_sign must be"),
    "no extension": (lambda m: m["global"].pop("core:extensions"), "must name mirrorwave"),
    "two channels": (lambda m: m["global"].update({"core:num_channels": 2}), "core:num_channels is 2: must be 1"),
    "data elsewhere": (lambda m: m["global"].update({"core:dataset": "x.bin"}), "core:dataset"),
    "damaged checksum": (lambda m: m["global"].update({"core:sha512": "0" * 128}), "data are damaged"),
    "no captures key": (lambda m: m.pop("captures"), "'captures' is a required property"),
    "no beams": (lambda m: m["captures"].clear(), "must hold at least one beam"),
    "one beam fewer": (lambda m: m["captures"].pop(), "size is 896 bytes: must be 768"),
    "one beam more": (
        lambda m: m["captures"].append(m["captures"][-1] | {"core:sample_start": 224, "mirrorwave:beam_index": 1}),
        "is 17.3|azimuth_deg",
    ),
    "start too far": (lambda m: m["captures"][6].update({"core:sample_start": 1 << 60}), r"captures\[6\]: core:sample"),
    "start negative": (lambda m: m["captures"][0].update({"core:sample_start": -1}), r"captures\[0\].*minimum"),
    "starts in disorder": (lambda m: m["captures"][2].update({"core:sample_start": 0}), "sample start ordering"),
    "no frequency": (lambda m: m["captures"][1].pop("core:frequency"), r"captures\[1\]: core:frequency is None"),
    "two carriers": (lambda m: m["captures"][1].update({"core:frequency": 77e9}), "must be that of the first beam"),
    "no azimuth": (lambda m: m["captures"][4].pop("mirrorwave:azimuth_deg"), r"captures\[4\]: mirrorwave:azimuth_deg"),
    "azimuth behind": (lambda m: m["captures"][4].update({"mirrorwave:azimuth_deg": 180.0}), "azimuth_deg is 180.0"),
    "azimuth that moved": (lambda m: m["captures"][4].update({"mirrorwave:azimuth_deg": 3.0}), "must be -1.1 as in an"),
    "index past the scan": (lambda m: m["captures"][1].update({"mirrorwave:beam_index": 3}), "beam_index is 3: must"),
    "same beam twice": (lambda m: m["captures"][1].update({"mirrorwave:beam_index": 0}), "azimuth_deg|past that beam"),
    "scans in disorder": (lambda m: m["captures"][6].update({"mirrorwave:scan_id": 1}), "past that beam already"),
    "weights short": (lambda m: m["captures"][0].update({"mirrorwave:steering_weights": [[1, 0]]}), "must be 8 pairs"),
    "weights of some": (
        lambda m: m["captures"][0].update({"mirrorwave:steering_weights": [[1, 0]] * 8}),
        r"captures\[1\]: mirrorwave:steering_weights is None",
    ),
    "background elsewhere": (lambda m: m["global"].update({"mirrorwave:background": "../b.npy"}), "beside the capture"),
    "background missing": (lambda m: m["global"].update({"mirrorwave:background": "b.npy"}), "cannot be read"),
    "beams unknown": (lambda m: m["global"].update({"mirrorwave:beams_per_scan": 25}), "evenly spaced|past that beam"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_one_line_naming_the_file(tmp_path: Path, name: str) -> None:
    change, rule = FAULTS[name]
    path = edit(tmp_path, change)
    with pytest.raises(ValueError, match=rule) as refused:
        SigmfCapture.open(path)
    assert "\n" not in str(refused.value)
    assert str(refused.value).startswith(str(tmp_path / "c.sigmf-"))
    assert len(str(refused.value)) < 500


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "{}", "7", "[" * 100_000, '{"global": 1}', "\ud800", "NaN"])
def test_metadata_that_are_none(tmp_path: Path, text: str) -> None:
    meta, _ = write_capture(tmp_path / "c", SETUP, beams(SETUP))
    meta.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(ValueError, match=r"c\.sigmf-meta: ") as refused:
        SigmfCapture.open(meta)
    assert "\n" not in str(refused.value)


def test_cut_data(tmp_path: Path) -> None:
    _, data = write_capture(tmp_path / "c", SETUP, beams(SETUP))
    raw = data.read_bytes()
    for size in (0, 1, len(raw) - 1, len(raw) - 4):
        data.write_bytes(raw[:size])
        with pytest.raises(ValueError, match=rf"c\.sigmf-data: size is {size} bytes: must be 896"):
            SigmfCapture.open(tmp_path / "c")


def test_flipped_sample_is_noticed_unless_unasked(tmp_path: Path) -> None:
    _, data = write_capture(tmp_path / "c", SETUP, beams(SETUP))
    raw = bytearray(data.read_bytes())
    raw[77] ^= 1
    data.write_bytes(raw)
    with pytest.raises(ValueError, match="data are damaged"):
        SigmfCapture.open(tmp_path / "c")
    assert len(list(SigmfCapture.open(tmp_path / "c", verify=False).beams())) == 7


def test_data_cut_while_open(tmp_path: Path) -> None:
    _, data = write_capture(tmp_path / "c", SETUP, beams(SETUP))
    capture = SigmfCapture.open(tmp_path / "c")
    data.write_bytes(data.read_bytes()[:200])
    with pytest.raises(ValueError, match="ends inside beam 1"):
        list(capture.beams())


def test_files_that_are_missing(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"none\.sigmf-meta: no such file"):
        SigmfCapture.open(tmp_path / "none")
    meta, data = write_capture(tmp_path / "c", SETUP, beams(SETUP))
    data.unlink()
    with pytest.raises(ValueError, match=r"c\.sigmf-data: no such file"):
        SigmfCapture.open(meta)


def test_background_of_another_shape(tmp_path: Path) -> None:
    write_capture(tmp_path / "c", FULL_SETUP, beams(FULL_SETUP))
    np.save(tmp_path / "c.background.npy", np.zeros((3, 15), np.complex64))
    with pytest.raises(ValueError, match=r"must hold complex64 \(3, 16\)"):
        SigmfCapture.open(tmp_path / "c")
    (tmp_path / "c.background.npy").write_bytes(b"\x93NUMPY\x01\x00garbage")
    with pytest.raises(ValueError, match="cannot be read"):
        SigmfCapture.open(tmp_path / "c")


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"samples": np.zeros((2, 8, 2), np.int16)}, "beam.samples must have the setup's shape"),
        ({"beam_count": 4}, "beam.beam_count must be the setup's 3"),
        ({"full_scale_dbm": 0.0}, "beam.full_scale_dbm must be the setup's"),
        ({"azimuth_rad": 0.5}, "beam.azimuth_rad must be the setup's"),
        ({"stamp_ns": -1}, "beam.stamp_ns must not be negative"),
    ],
)
def test_writer_refuses_and_leaves_nothing(tmp_path: Path, change: dict[str, Any], rule: str) -> None:
    good = list(beams(SETUP, 2))
    with pytest.raises(ValueError, match=rule):
        write_capture(tmp_path / "c", SETUP, [good[0], msgspec.structs.replace(good[1], **change)])
    assert list(tmp_path.iterdir()) == []


def test_writer_refuses_disorder_and_nothing_at_all(tmp_path: Path) -> None:
    good = list(beams(SETUP, 2))
    with pytest.raises(ValueError, match="must rise within a scan"):
        write_capture(tmp_path / "c", SETUP, reversed(good))
    with pytest.raises(ValueError, match="cannot be empty"):
        write_capture(tmp_path / "c", SETUP, [])


def test_existing_capture_is_kept_unless_asked(tmp_path: Path) -> None:
    write_capture(tmp_path / "c", SETUP, beams(SETUP))
    with pytest.raises(FileExistsError, match="exists already"):
        write_capture(tmp_path / "c", SETUP, beams(SETUP, 2))
    write_capture(tmp_path / "c", SETUP, beams(SETUP, 2), overwrite=True)
    assert len(SigmfCapture.open(tmp_path / "c")) == 2
