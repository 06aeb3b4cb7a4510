"""The radar driver on a kit without hardware: pyadi-iio's own classes on a stand-in for libiio."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from contrib.boards import phaser_device, phaser_radar
from contrib.boards.phaser_model import SAMPLES_PER_CHIRP, PhaserParams
from mirrorwave.cli import main
from models.perception.form.ra_former import RaFormer
from msgs.bus.interface import Outgoing
from msgs.bus.local import LocalNetwork
from msgs.files.shipped import CHECKOUT
from msgs.recording.sigmf import SigmfCapture, write_capture
from msgs.values.diagnostics import NodeState
from msgs.values.radar import RadarSetup, RangeAzimuthMap
from nodes.node import InProcessGraph, load_node
from nodes.process.launch_file import read_launch_file
from nodes.ra_former import Params as FormerParams
from nodes.ra_former import create as create_former
from tests.contrib.boards.phaser_stand_in import BOARD_URI, CONVERTER_URI, StandInKit, library_on

KIT = {"board_uri": BOARD_URI, "converter_uri": CONVERTER_URI}
#: Gains measured on a board (1 at the weakest element), and phases of about the spread such boards have.
GAINS = (0.638, 0.813, 0.790, 0.974, 0.770, 0.800, 0.614, 1.0)
PHASES_DEG = (0.0, 14.0, -33.0, 80.0, 122.0, -61.0, 9.0, 170.0)
needs_library = pytest.mark.skipif(importlib.util.find_spec("adi") is None, reason="pyadi-iio (extra phaser) is absent")


def start(monkeypatch: pytest.MonkeyPatch, library: Any, **params: Any) -> phaser_radar.RadarDriver:
    """The node as a launch file makes it, on `library`."""
    monkeypatch.setattr(phaser_device.Cn0566.__init__, "__defaults__", (None, lambda: library))
    kit = {**KIT, "chirps_per_beam": 2, **params.pop("cn0566", {})}
    node = load_node("contrib.boards.phaser_radar", {"cn0566": kit, **params})
    assert isinstance(node, phaser_radar.RadarDriver)
    return node


@pytest.fixture
def kit() -> StandInKit:
    return StandInKit()


@pytest.fixture
def library(kit: StandInKit) -> Iterator[Any]:
    with library_on(kit) as found:
        yield found


def turn(node: phaser_radar.RadarDriver, now_ns: int) -> tuple[list[Outgoing], int]:
    """One step when the node is due, and when that was."""
    due_ns = node.due_ns(now_ns)
    assert due_ns is not None
    return node.step([], max(due_ns, now_ns)), max(due_ns, now_ns)


def turns(node: phaser_radar.RadarDriver, count: int, now_ns: int = 1_000_000_000) -> list[Any]:
    """Messages of so many steps."""
    out: list[Any] = []
    for _ in range(count):
        sent, now_ns = turn(node, now_ns)
        out += [one.message for one in sent]
    return out


def maps_of(node: phaser_radar.RadarDriver) -> list[RangeAzimuthMap]:
    """What the RA former makes of a driver that ends by itself, on an in-process bus."""
    network = LocalNetwork(start_ns=5_000_000_000)
    listener = network.bus("listener")
    listener.subscribe("radar/ra_map")
    # threads of the wall clock would spoil a virtual one
    node._clock_ns = lambda: 0
    graph = InProcessGraph(network, {"radar_driver": node, "ra_former": create_former(FormerParams())})
    graph.run()
    graph.close()
    return [received.message for received in listener.receive(0.0)]


def strongest(ra_map: RangeAzimuthMap) -> tuple[float, float]:
    """Range and azimuth in degrees of the strongest cell."""
    row, column = np.unravel_index(np.abs(ra_map.values).argmax(), ra_map.grid.shape)
    return float(ra_map.grid.range_m[row]), float(np.degrees(ra_map.grid.azimuth_rad[column]))


@needs_library
@pytest.mark.parametrize(("range_m", "azimuth_deg"), [(12.0, 20.0), (55.3, -41.0), (4.0, 0.0)])
def test_a_point_target_comes_out_where_it_is(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, range_m: float, azimuth_deg: float
) -> None:
    """Driver, library and former in line; a board with gains and phases of its own, calibrated; noise of one code.

    Known bias: none in azimuth; bins of 0.35 m. Tolerance: one range bin, 1 degree (cells of 0.47).
    """
    kit = StandInKit(
        ((range_m, azimuth_deg, 3.0),), 1.0 / np.array(GAINS), -np.array(PHASES_DEG), noise_codes=1.0, seed=4
    )
    path = tmp_path / "calibration.yaml"
    path.write_text(f"gains: {list(GAINS)}\nphases_deg: {list(PHASES_DEG)}\n")
    with library_on(kit) as library:
        (ra_map,) = maps_of(start(monkeypatch, library, scans=1, cn0566={"calibration": str(path)}))
    found_m, found_deg = strongest(ra_map)
    assert found_m == pytest.approx(range_m, abs=0.36)
    assert found_deg == pytest.approx(azimuth_deg, abs=1.0)
    assert not ra_map.incoherent[round(range_m / ra_map.grid.range_bin_m)]
    assert ra_map.faults == ()
    assert ra_map.missing_beams == ()


@needs_library
def test_the_setup_says_what_the_kit_is(monkeypatch: pytest.MonkeyPatch, library: Any) -> None:
    """First the set-up with the clock of the bus: one way, 8 columns, weights as set; then beams that fit it."""
    setup, *beams = turns(start(monkeypatch, library), 6)
    assert isinstance(setup, RadarSetup)
    assert setup.stamp_ns == 1_000_000_000
    assert (setup.array.steered_ways, setup.array.columns, setup.beat_sign) == (1, 8, 1)
    assert setup.steering_weights is not None
    assert setup.radar.chirp_interval_s == 500e-6
    assert [(beam.scan_id, beam.beam_index) for beam in beams] == [(0, index) for index in range(5)]
    former = RaFormer(setup)
    for beam in beams:
        former.add(beam)


@needs_library
def test_a_capture_keeps_what_the_setup_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, library: Any) -> None:
    """Rests between chirps, one steered way and the weights as set come back from a SigMF capture."""
    setup, *beams = turns(start(monkeypatch, library, scans=1), 26)
    capture = SigmfCapture.open(write_capture(tmp_path / "phaser", setup, beams)[0])
    assert capture.setup.array == setup.array
    assert capture.setup.radar == setup.radar
    np.testing.assert_array_equal(capture.setup.steering_weights, setup.steering_weights)
    np.testing.assert_array_equal(next(iter(capture.beams())).samples, beams[0].samples)


@needs_library
def test_beams_keep_the_pace_and_scans_count_on(monkeypatch: pytest.MonkeyPatch, library: Any) -> None:
    node = start(monkeypatch, library, azimuth_deg=[-20.0, 0.0, 20.0], scans=2, cn0566={"scan_period_s": 0.3})
    node._clock_ns = lambda: 0
    _, *beams = turns(node, 7)
    assert [(beam.scan_id, beam.beam_index) for beam in beams] == [(s, b) for s in (0, 1) for b in (0, 1, 2)]
    assert np.diff([beam.stamp_ns for beam in beams]).tolist() == [100_000_000] * 5
    assert beams[0].stamp_ns == 1_300_000_000
    assert not node.finished()
    assert turns(node, 1, beams[-1].stamp_ns) == []
    assert node.finished()


@needs_library
def test_a_stamp_is_taken_when_the_chirps_begin(monkeypatch: pytest.MonkeyPatch, library: Any) -> None:
    """Steering took 7 ms of the step: the stamp is 7 ms after its start."""
    node = start(monkeypatch, library)
    ticks = iter([0, 7_000_000])
    node._clock_ns = lambda: next(ticks)
    _, beam = turns(node, 2)
    assert beam.stamp_ns == 1_307_000_000


@needs_library
def test_a_lost_link_degrades_and_comes_back(
    monkeypatch: pytest.MonkeyPatch, kit: StandInKit, library: Any, caplog: pytest.LogCaptureFixture
) -> None:
    node = start(monkeypatch, library)
    assert len(turns(node, 4)) == 4
    kit.reachable = False
    now_ns, waits_s = 2_000_000_000, []
    for _ in range(7):
        sent, now_ns = turn(node, now_ns)
        assert sent == []
        waits_s.append(1e-9 * (node.due_ns(now_ns) - now_ns))  # type: ignore[operator]
    assert waits_s == [0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0]
    state, reason = node.health()
    assert state is NodeState.DEGRADED
    assert "ip:converter.test" in reason
    assert "\n" not in reason
    assert [record.message for record in caplog.records if record.levelname == "WARNING"] == [
        "cn0566: ip:board.test, ip:converter.test no longer answer ([Errno 113] No route to host): "
        "check power and cables"
    ]
    kit.reachable = True
    (beam,) = turns(node, 1, now_ns)
    assert (beam.scan_id, beam.beam_index) == (1, 0)
    assert node.health() == (NodeState.READY, "")
    assert [(count.what, count.reason, count.count) for count in node.shed.counts()] == [("scan", "link lost", 1)]


@needs_library
def test_a_kit_that_answers_but_never_measures_is_tried_less_and_less(
    monkeypatch: pytest.MonkeyPatch, kit: StandInKit, library: Any
) -> None:
    kit.deaf = True
    node = start(monkeypatch, library)
    now_ns, waits_s = 2_000_000_000, []
    node.step([], now_ns)
    for _ in range(4):
        sent, now_ns = turn(node, now_ns)
        assert sent == []
        waits_s.append(1e-9 * (node.due_ns(now_ns) - now_ns))  # type: ignore[operator]
    assert waits_s == [0.5, 1.0, 2.0, 4.0]
    assert "timed out" in node.health()[1]


@needs_library
def test_a_short_burst_is_left_out_and_named(monkeypatch: pytest.MonkeyPatch, kit: StandInKit, library: Any) -> None:
    node = start(monkeypatch, library)
    turns(node, 2)
    kit.short = True
    assert turns(node, 1, 2_000_000_000) == []
    assert node.health() == (NodeState.DEGRADED, "burst must be of 4000 samples, got 2000")
    kit.short = False
    (beam,) = turns(node, 1, 3_000_000_000)
    assert beam.beam_index == 2
    assert node.health()[0] is NodeState.READY
    assert [(count.what, count.reason) for count in node.shed.counts()] == [("beam", "no sound burst")]


@needs_library
def test_a_slow_radar_says_so(monkeypatch: pytest.MonkeyPatch, library: Any) -> None:
    """Three beams a scan, each 0.2 s late: no hurry, and a word after the first scan."""
    node = start(monkeypatch, library, azimuth_deg=[-20.0, 0.0, 20.0], cn0566={"scan_period_s": 0.3})
    now_ns = 1_000_000_000
    for _ in range(5):
        _, now_ns = turn(node, now_ns)
        now_ns += 300_000_000
    assert node.health() == (NodeState.DEGRADED, "a scan takes 0.90 s, scan_period_s says 0.3 s")


@needs_library
def test_closing_silences_the_kit(monkeypatch: pytest.MonkeyPatch, kit: StandInKit, library: Any) -> None:
    node = start(monkeypatch, library)
    turns(node, 3)
    node.close()
    channel = kit.ramp.find_channel("altvoltage0", True)
    assert channel is not None
    assert (channel.attrs["ramp_mode"].value, channel.attrs["powerdown"].value) == ("disabled", "1")
    assert kit.timing.attrs["enable"].value == "0"
    muted = kit.phy.find_channel("voltage1", True)
    assert muted is not None
    assert float(muted.attrs["hardwaregain"].value) == -88.0


@needs_library
def test_closing_a_lost_kit_says_nothing(monkeypatch: pytest.MonkeyPatch, kit: StandInKit, library: Any) -> None:
    node = start(monkeypatch, library)
    kit.reachable = False
    node.close()
    node.close()


@needs_library
def test_a_kit_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch, kit: StandInKit, library: Any) -> None:
    kit.reachable = False
    with pytest.raises(ValueError, match=r"^cn0566: no Pluto at ip:converter\.test \(No device found\): check power"):
        start(monkeypatch, library)
    kit.reachable = True
    with pytest.raises(ValueError, match=r"^cn0566: no board at ip:elsewhere \(No device found\): check power"):
        start(monkeypatch, library, cn0566={"board_uri": "ip:elsewhere"})


@needs_library
def test_a_synthesiser_that_takes_another_ramp_is_refused(
    monkeypatch: pytest.MonkeyPatch, kit: StandInKit, library: Any
) -> None:
    channel = kit.ramp.find_channel("altvoltage0", True)
    assert channel is not None
    channel.attrs["frequency_deviation_time"]._on_write = lambda text: setattr(
        channel.attrs["frequency_deviation_time"], "_text", "290"
    )
    with pytest.raises(ValueError, match=r"cn0566: freq_dev_time must be 300, the synthesiser took 290"):
        start(monkeypatch, library)
    assert channel.attrs["ramp_mode"].value == "disabled"


@needs_library
@pytest.mark.parametrize(
    ("taken_hz", "is_refused"), [(125_125_000, False), (124_875_000, False), (125_125_001, True), (124_874_999, True)]
)
def test_a_ramp_may_be_off_by_a_thousandth(
    monkeypatch: pytest.MonkeyPatch, kit: StandInKit, library: Any, taken_hz: int, is_refused: bool
) -> None:
    """500 MHz behind a divider of 4 are 125 MHz: 125 kHz to either side, that itself included."""
    channel = kit.ramp.find_channel("altvoltage0", True)
    assert channel is not None
    swept = channel.attrs["frequency_deviation_range"]
    swept._on_write = lambda text: setattr(swept, "_text", str(taken_hz))
    if is_refused:
        with pytest.raises(ValueError, match=r"cn0566: freq_dev_range must be 125000000, the synthesiser took 1\.2"):
            start(monkeypatch, library)
    else:
        start(monkeypatch, library)


@needs_library
def test_the_stand_in_refuses_what_the_library_does_not_have(library: Any) -> None:
    """A misspelt attribute would be a new one on a plain object, and nobody would know."""
    board = library.CN0566(uri=BOARD_URI)
    with pytest.raises(AttributeError, match="freq_dev_rnage"):
        board.freq_dev_rnage = 1
    with pytest.raises(ValueError, match="ramp_mode"):
        board.ramp_mode = "sawteeth"


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"scans": 0}, r"radar_driver\.scans must be finite and positive, got 0"),
        ({"azimuth_deg": []}, r"beams\.azimuth_deg must name at least one beam"),
        ({"cn0566": {"chirps_per_beam": 0}}, r"params\.cn0566: chirps_per_beam must be finite and positive"),
        ({"cn0566": {"uri": "ip:x"}}, r"params\.cn0566: Object contains unknown field uri"),
    ],
)
def test_wrong_parameters_are_one_line(params: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_node("contrib.boards.phaser_radar", params)


def test_a_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise ModuleNotFoundError(f"No module named {name!r}")

    def too_old(name: str) -> Any:
        raise OSError(2, "libiio version 1.x required, found version 0")

    monkeypatch.setattr(phaser_device.importlib, "import_module", missing)
    with pytest.raises(ValueError, match=r"^cn0566 needs pyadi-iio, extra `phaser`: No module named 'adi'$"):
        phaser_device.load_library()
    monkeypatch.setattr(phaser_device.importlib, "import_module", too_old)
    with pytest.raises(ValueError, match=r"^cn0566 needs libiio 0\.x .*found version 0$"):
        phaser_device.load_library()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gains: [1, 1]\n", r"gains must be 8 numbers"),
        ("gain: 1\n", r"unknown field gain"),
        ("", r"calibration\.yaml"),
        ("gains: [.nan, 1, 1, 1, 1, 1, 1, 1]\n", r"gains must be 8 numbers"),
    ],
    ids=["short", "unknown", "empty", "not a number"],
)
def test_a_wrong_calibration_file_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "calibration.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        phaser_device.load_calibration(path)
    assert str(path) in str(raised.value)


def test_the_launch_file_fits_the_node() -> None:
    entry = read_launch_file(CHECKOUT / "launch" / "phaser.yaml").nodes["radar_driver"]
    params = msgspec.convert(entry.params, phaser_radar.Params)
    assert isinstance(params.cn0566, PhaserParams)


def test_a_beam_fits_its_topic() -> None:
    from msgs.bus.topics import topic_facts

    params = PhaserParams(chirps_per_beam=256)
    assert 4 * params.chirps_per_beam * SAMPLES_PER_CHIRP < topic_facts("radar/beam").max_bytes


def element_capture(monkeypatch: pytest.MonkeyPatch, kit: StandInKit, path: Path, scans: int, chirps: int = 16) -> Path:
    """A capture of single elements, as the driver gives it."""
    settings = {"single_elements": True, "chirps_per_beam": chirps}
    with library_on(kit) as library:
        node = start(monkeypatch, library, scans=scans, cn0566=settings)
        setup, *beams = turns(node, 1 + 8 * scans)
    write_capture(path, setup, iter(beams))
    return path


@needs_library
@pytest.mark.parametrize("azimuth_deg", [0.0, 15.0])
def test_a_board_is_calibrated_element_by_element(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, azimuth_deg: float
) -> None:
    """Layout: a reflector at 40 m, driver in single-element mode, `calibrate array`, and the file into the driver.

    Analytic: phases to add are those that the stand-in's elements lack; gain times element times channel is one level.
    Known bias: the stand-in's wave is plane, the calibration's a sphere, 0.4 deg at 40 m. Tolerance: 1 deg, 1 %.
    """
    kit = StandInKit(((40.0, azimuth_deg, 300.0),), 1.0 / np.array(GAINS), -np.array(PHASES_DEG), seed=5)
    capture = element_capture(monkeypatch, kit, tmp_path / "elements.sigmf-meta", 4)
    out = tmp_path / "board.yaml"
    arguments = ("calibrate", "array", str(capture), "--out", str(out), "--range-m", "30", "50")
    assert main([*arguments, "--azimuth-deg", str(azimuth_deg)]) == 0
    found = phaser_device.load_calibration(out)
    off_deg = (np.array(found.phases_deg) - np.array(PHASES_DEG) + 180.0) % 360.0 - 180.0
    assert np.abs(off_deg).max() < 1.0
    channels = 10.0 ** (np.repeat(found.channel_gains_db, 4) / 20.0)
    level = np.array(found.gains) / np.array(GAINS) * channels
    assert np.abs(level / level.mean() - 1.0).max() < 0.01
    assert max(found.gains) == 1.0


@needs_library
def test_elements_that_serve_no_calibration_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A dead element, a reflector that is not there, a gate beyond the profile, a converter at its limit, scans too
    few: one line each."""
    gains = np.ones(8)
    gains[2] = 0.0
    dead = element_capture(monkeypatch, StandInKit(((40.0, 0.0, 300.0),), gains), tmp_path / "dead.sigmf-meta", 4)
    sound = element_capture(monkeypatch, StandInKit(((40.0, 0.0, 300.0),)), tmp_path / "sound.sigmf-meta", 4)
    loud = element_capture(monkeypatch, StandInKit(((40.0, 0.0, 9000.0),)), tmp_path / "loud.sigmf-meta", 4)
    few = element_capture(monkeypatch, StandInKit(((40.0, 0.0, 300.0),)), tmp_path / "few.sigmf-meta", 2)
    for path, gate, said in (
        (dead, ("30", "50"), "element 3 has"),
        (sound, ("60", "70"), "the reflector must stand 20 dB over the noise of every element"),
        (sound, ("30", "500"), "range_m must be 0 < LOW < HIGH <"),
        (sound, ("nan", "50"), "range_m must be 0 < LOW < HIGH <"),
        (loud, ("30", "50"), "samples must stay under full scale, those of element 1 do not"),
        (few, ("30", "50"), "at least 4 complete scans, got 2"),
    ):
        out = tmp_path / "board.yaml"
        assert main(["calibrate", "array", str(path), "--out", str(out), "--range-m", *gate]) == 2
        line = capsys.readouterr().err
        assert said in line
        assert line.count("\n") == 1
        assert not out.exists()


def test_a_calibrated_board_is_not_measured_bare() -> None:
    with pytest.raises(ValueError, match="calibration must not be given"):
        phaser_device.Params(single_elements=True, calibration="board.yaml")
