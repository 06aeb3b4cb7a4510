"""A board with a capture card as a node: set-up and beams equal to the file's, losses stated, a card that is lost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from contrib.boards import dca1000_radar
from contrib.boards import dca1000_socket as dca1000
from contrib.boards.config_file import read_config
from contrib.boards.dca1000_capture import Dca1000Config, array_params, frame_samples
from contrib.boards.dca1000_packets import PAYLOAD_BYTES, WINDOW, datagram
from contrib.boards.digital_row import radar_setup, row_beams
from models.perception.form.ra_former import RaFormer
from models.perception.form.ra_forming import FormingParams
from msgs.bus.interface import Outgoing
from msgs.values.diagnostics import NodeState
from msgs.values.radar import RadarBeam, RadarSetup, RangeAzimuthMap
from nodes.node import load_node
from nodes.process.launch_file import read_launch_file
from tests.captures import DATA, needs
from tests.contrib.boards.dca1000_stand_in import Faults, StandInCard, datagrams_of, with_faults
from tests.contrib.boards.test_dca1000_socket import PCAP, udp_payloads, until
from tests.contrib.boards.test_import_dca1000 import AZIMUTH_DEG, CFG, LOOPS, RANGE_M, point, two_lanes

TASK3 = DATA / "awr1843_com405_task3"
MS = 1_000_000
FRAME = two_lanes(point())


class ListedCard:
    """A card in memory: `take` returns what `arrive` put in."""

    def __init__(self) -> None:
        self.counts = dca1000.LinkCounts()
        self.waiting: list[tuple[bytes, int]] = []
        self.words: list[str] = []
        self.errors: list[Exception] = []
        self.opened = 0

    def arrive(self, contents: list[bytes], stamp_ns: int = 0) -> None:
        self.waiting += [(content, stamp_ns) for content in contents]

    def open(self) -> None:
        if self.errors:
            raise self.errors.pop(0)
        self.opened += 1

    def take(self) -> list[tuple[bytes, int]]:
        taken, self.waiting = self.waiting, []
        return taken

    def reports(self) -> list[str]:
        words, self.words = self.words, []
        return words

    def close(self) -> None:
        """Nothing to let go of."""


def listed(folder: Path, text: str = CFG, **params: Any) -> tuple[dca1000_radar.Dca1000Radar, ListedCard]:
    """A node on a card in memory, its set-up sent."""
    path = folder / "chirps.cfg"
    path.write_text(text)
    card = ListedCard()
    node = dca1000_radar.Dca1000Radar(dca1000_radar.Params(config=str(path), **params), lambda _, lanes: card)
    node.open()
    (out,) = node.step([], 0)
    assert isinstance(out.message, RadarSetup)
    return node, card


def beams_after(node: dca1000_radar.Dca1000Radar, now_ns: int) -> list[RadarBeam]:
    """Beams of all frames that are complete by then."""
    out: list[Outgoing] = list(node.step([], now_ns))
    while node.pending():
        out += node.step([], now_ns)
    return [one.message for one in out if isinstance(one.message, RadarBeam)]


def shed(node: dca1000_radar.Dca1000Radar) -> dict[tuple[str, str], int]:
    return {(count.what, count.reason): count.count for count in node.shed.counts()}


def map_of(setup: RadarSetup, beams: list[RadarBeam]) -> RangeAzimuthMap:
    former = RaFormer(setup, FormingParams(slow_time_sums=None))
    (ra_map,) = [ra_map for beam in beams for ra_map in former.add(beam)]
    return ra_map


def strongest(ra_map: RangeAzimuthMap) -> tuple[float, float, float]:
    """Range, azimuth in degrees and radial speed of the strongest cell."""
    cell = np.unravel_index(np.abs(ra_map.values).argmax(), ra_map.grid.shape)
    row, column = cell
    speed_mps = float(ra_map.radial_speed_mps((int(row), int(column))))
    return float(ra_map.grid.range_m[row]), float(np.degrees(ra_map.grid.azimuth_rad[column])), speed_mps


@pytest.mark.parametrize("speed_mps", [0.0, 1.0, 4.0, -5.0])
def test_a_point_comes_out_where_it_is(tmp_path: Path, speed_mps: float) -> None:
    """A point of 3 m and 20 deg, by a cube written without the program, through node and former.

    Tolerance: half a bin of 9.8 cm, rounded up, and 1.2 azimuth cells of 0.47 deg; speeds within a quarter of the
    0.33 m/s bin. At 5 m/s, near the limit of 5.2, the slots of the two transmitters are half a turn apart.
    """
    node, card = listed(tmp_path)
    card.arrive(datagrams_of(two_lanes(point(speed_mps=speed_mps))), 7 * MS)
    beams = beams_after(node, 10 * MS)
    assert [(beam.scan_id, beam.beam_index, beam.stamp_ns) for beam in beams] == [(0, at, 7 * MS) for at in range(8)]
    ra_map = map_of(node._setup, beams)
    range_m, azimuth_deg, radial_mps = strongest(ra_map)
    assert range_m == pytest.approx(RANGE_M, abs=0.05)
    assert azimuth_deg == pytest.approx(AZIMUTH_DEG, abs=0.6)
    assert radial_mps == pytest.approx(-speed_mps, abs=0.08)
    assert (ra_map.faults, ra_map.missing_beams, bool(ra_map.incoherent.any())) == ((), (), False)


def test_the_order_of_transmitters_does_not_matter(tmp_path: Path) -> None:
    """Second transmitter first: the same map, and receivers that run to the right turn it round."""
    config = CFG.replace("chirpCfg 0 0 0 0 0 0 0 1\nchirpCfg 1 1 0 0 0 0 0 2", "chirpCfg 1 1 0 0 0 0 0 1")
    config += "chirpCfg 0 0 0 0 0 0 0 2\n"
    for mirrored, sign in ((False, 1.0), (True, -1.0)):
        node, card = listed(tmp_path, config, mirrored=mirrored)
        card.arrive(datagrams_of(two_lanes(point((4, 0), speed_mps=3.0))))
        range_m, azimuth_deg, _ = strongest(map_of(node._setup, beams_after(node, 10 * MS)))
        assert range_m == pytest.approx(RANGE_M, abs=0.05)
        assert azimuth_deg == pytest.approx(sign * AZIMUTH_DEG, abs=0.6)


def test_missing_loops_are_zero_and_said(tmp_path: Path) -> None:
    """One datagram of a frame is lost: its loops are zero in every beam, the map says `lost_chirps`, the point stands.

    A loop has 2048 bytes, so that the third datagram, bytes 2912..4368, is of loops 1 and 2.
    """
    node, card = listed(tmp_path)
    sent = datagrams_of(FRAME * 3)
    card.arrive(sent[:2] + sent[3:])
    beams = beams_after(node, 10 * MS)
    assert node.health() == (NodeState.READY, "")
    assert [beam.scan_id for beam in beams] == [0] * 8 + [1] * 8 + [2] * 8
    for beam in beams[:8]:
        assert np.flatnonzero(~beam.samples.any(axis=(1, 2))).tolist() == [1, 2]
    first = map_of(node._setup, beams[:8])
    assert first.faults == ("lost_chirps",)
    assert strongest(first)[0] == pytest.approx(RANGE_M, abs=0.05)
    assert map_of(node._setup, beams[8:16]).faults == ()
    assert shed(node) == {("datagram", "lost"): 1, ("frame", "filled"): 1}


def test_a_frame_with_zeros_degrades_until_the_next_whole_frame(tmp_path: Path) -> None:
    """Frame 1 is bytes 65536..131071: datagrams 60 and 61, bytes 87360..90271, are of its loops 10, 11 and 12."""
    node, card = listed(tmp_path)
    sent = datagrams_of(FRAME * 4)
    # the window behind the frame, and no byte of the next one's end
    card.arrive(sent[:60] + sent[62 : 62 + 30 + WINDOW])
    assert len(node.step([], 10 * MS)) == 8
    assert node.health() == (NodeState.READY, "")
    assert len(node.step([], 10 * MS)) == 8
    assert node.health() == (
        NodeState.DEGRADED, "scan 1: 2912 of 65536 bytes are missing, zeros in 3 of 32 loops",
    )  # fmt: skip
    card.arrive(sent[62 + 30 + WINDOW :])
    assert len(beams_after(node, 20 * MS)) == 16
    assert node.health() == (NodeState.READY, "")


def test_a_frame_without_a_whole_loop_is_left_out(tmp_path: Path) -> None:
    """One loop a frame, as in a capture of 3 chirps: a single lost datagram leaves nothing that adds up."""
    node, card = listed(tmp_path, CFG.replace(f"frameCfg 0 1 {LOOPS}", "frameCfg 0 1 1"))
    one = two_lanes(point(loops=1))
    sent = datagrams_of(one * 120)
    card.arrive(sent[:1] + sent[2:20])
    beams = beams_after(node, 10 * MS)
    assert beams == []
    card.arrive(sent[20:])
    beams = beams_after(node, 20 * MS)
    # those that the poll found together are more than may wait
    assert {beam.scan_id for beam in beams} == {116, 117, 118, 119}
    counts = shed(node)
    assert counts["datagram", "lost"] == 1
    assert counts["frame", "behind"] == 116


def test_foreign_datagrams_are_refused_and_said(tmp_path: Path) -> None:
    node, card = listed(tmp_path)
    card.arrive([bytes(1400), b"", datagram(9, 3, b"ab")])
    assert beams_after(node, 10 * MS) == []
    state, reason = node.health()
    assert state is NodeState.DEGRADED
    assert reason.startswith("datagram 9 must hold bytes that lie 9 datagrams")
    assert shed(node)["datagram", "refused"] == 3
    card.arrive(datagrams_of(FRAME))
    assert len(beams_after(node, 20 * MS)) == 8
    assert node.health() == (NodeState.READY, "")


def test_a_silent_card_is_said_and_opened_again(tmp_path: Path) -> None:
    """3 s without datagrams: DEGRADED; 20 s later another recording, whose scans count on."""
    node, card = listed(tmp_path)
    card.arrive(datagrams_of(FRAME * 2))
    assert [beam.scan_id for beam in beams_after(node, 10 * MS)][-1] == 1
    now_ns = 10 * MS
    reasons = []
    while card.opened == 1:
        now_ns = max(node.due_ns(now_ns) or 0, now_ns + 100 * MS)
        assert beams_after(node, now_ns) == []
        reasons.append(node.health()[1])
    assert reasons[20] == ""
    assert "no samples for 4 s: is the board started?" in reasons
    assert "the card is silent; next try in 0.5 s" in reasons
    assert now_ns < 30_000 * MS
    card.arrive(datagrams_of(FRAME * 2))
    beams = beams_after(node, node.due_ns(now_ns) or 0)
    assert [beam.scan_id for beam in beams[::8]] == [2, 3]
    assert node.health() == (NodeState.READY, "")


def test_a_recording_that_ends_and_a_card_that_is_gone(tmp_path: Path) -> None:
    """The report that it is completed; then tries at growing intervals until the card answers again."""
    node, card = listed(tmp_path)
    card.words = ["recording completed"]
    card.errors = [ConnectionError("dca1000: gone")] * 6
    assert node.step([], 5 * MS) == []
    assert node.health() == (
        NodeState.DEGRADED, "the recording has ended (recording completed): start the board; next try in 0.5 s",
    )  # fmt: skip
    dues = [5 * MS]
    while card.opened == 1:
        dues.append(node.due_ns(0) or 0)
        assert node.step([], dues[-1]) == []
    assert np.diff(dues).tolist() == [500 * MS, 1000 * MS, 2000 * MS, 4000 * MS, 8000 * MS, 10000 * MS, 10000 * MS]
    card.arrive(datagrams_of(FRAME))
    assert len(beams_after(node, node.due_ns(0) or 0)) == 8
    assert node.health() == (NodeState.READY, "")


def test_a_card_that_is_absent_at_the_start_is_bad_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dca1000, "TIMEOUT_S", 0.1)
    (tmp_path / "chirps.cfg").write_text(CFG)
    nobody = {"host_address": "127.0.0.1", "card_address": "127.0.0.3"}
    with pytest.raises(ValueError, match=r"dca1000: card at 127\.0\.0\.3 does not answer command 0x09"):
        load_node("contrib.boards.dca1000_radar", {"config": str(tmp_path / "chirps.cfg"), "card": nobody})
    with pytest.raises(FileNotFoundError):
        load_node("contrib.boards.dca1000_radar", {"config": str(tmp_path / "no.cfg")})


@pytest.mark.parametrize(
    ("old", "new", "rule"),
    [
        ("channelCfg 15 3 0", "channelCfg 10 3 0", "at least two channels half a wavelength apart, got places 1, 3, 5"),
        ("channelCfg 15 3 0", "channelCfg 1 3 0", "at least two channels half a wavelength apart, got places 0, 4"),
        ("0 0 0 0 0 2\n", "0 0 0 0 0 1\n", "at least two channels half a wavelength apart, got places 0, 0, 1"),
    ],
)
def test_a_row_with_gaps_or_doubles_is_refused(tmp_path: Path, old: str, new: str, rule: str) -> None:
    with pytest.raises(ValueError, match=f"channelCfg.rx_mask and chirpCfg.tx_mask must give {rule}"):
        listed(tmp_path, CFG.replace(old, new))


def test_the_launch_file_names_a_configuration_that_makes_a_row() -> None:
    params = read_launch_file(Path("launch/awr1843.yaml")).nodes["radar"].params
    config = read_config(Path(params["config"]), None)
    setup = radar_setup(config)
    assert (setup.array.columns, setup.radar.samples_per_chirp, len(setup.beams)) == (8, 128, 8)


def played(config: Path, datagrams: list[bytes], is_done: Callable[[dca1000_radar.Dca1000Radar, int], bool]) -> Any:
    """Beams and node after a stand-in card has sent all on the loopback."""
    stand_in = StandInCard(datagrams)
    node = dca1000_radar.Dca1000Radar(dca1000_radar.Params(config=str(config), card=stand_in.params))
    stand_in.taken = lambda: node._card.counts.taken
    beams: list[RadarBeam] = []
    try:
        node.open()
        node.step([], 0)
        now_ns = 0

        def has_all() -> bool:
            nonlocal now_ns
            now_ns += 5 * MS
            beams.extend(beams_after(node, now_ns))
            return is_done(node, len(beams))

        until(has_all, 60.0)
    finally:
        node.close()
        stand_in.close()
    return beams, node


def expected_beams(config: Dca1000Config, recording: bytes, frame: int) -> np.ndarray:
    """Beams of a frame of a file, by the import's own reading of it."""
    codes = np.frombuffer(recording, "<i2", config.frame_bytes // 2, frame * config.frame_bytes)
    return row_beams(frame_samples(codes, config), radar_setup(config), array_params(config))


@needs(TASK3)
def test_a_real_capture_as_datagrams(monkeypatch: pytest.MonkeyPatch) -> None:
    """2110 datagrams of the AWR1843 on the loopback, 1 % lost, some overtaken by up to 8: whole frames are the file's.

    The file's frames have one loop, so that those with a loss are left out: of 1000, about 21 datagrams of two each.
    """
    monkeypatch.setattr(dca1000_radar, "MAX_WAITING", 1000)
    recording = (TASK3 / "task3_gt_Raw_0.bin").read_bytes()
    config_path = TASK3 / "1843_config_debug_task3.lua"
    config = read_config(config_path, None)
    sent, lost, _ = with_faults(datagrams_of(recording), Faults(lost=0.01, overtaken=8.0, seed=5))
    total = len(datagrams_of(recording))
    beams, node = played(config_path, sent, lambda node, _: node._assembler.counts.placed >= total - lost)
    counts = node._assembler.counts
    assert (counts.placed, counts.lost, counts.late, counts.refused) == (total - lost, lost, 0, 0)
    scans = sorted({beam.scan_id for beam in beams})
    assert 900 < len(scans) < 1000
    for beam in beams:
        if beam.beam_index == 0:
            expected = expected_beams(config, recording, beam.scan_id)
        np.testing.assert_array_equal(beam.samples, expected[beam.beam_index])


@needs(PCAP)
def test_recorded_traffic_of_a_card(tmp_path: Path) -> None:
    """12 datagrams of a real card, sent again: samples equal to what an outside parser makes of them.

    Its array is flat, in the order of the file: 4 receivers of 256 samples, Q before I.
    """
    contents = [content for port, content in udp_payloads((PCAP / "test_one_frame.pcap").read_bytes()) if port == 4098]
    assert [len(content) for content in contents] == [10 + PAYLOAD_BYTES] * 11 + [378]
    text = (PCAP / "xwr18xx_profile.cfg").read_text().replace("frameCfg 0 1 16 0 100", "frameCfg 0 1 2 0 100")
    path = tmp_path / "profile.cfg"
    path.write_text(text)
    config = read_config(path, None)
    frames = []
    node = dca1000_radar.Dca1000Radar(dca1000_radar.Params(config=str(path)))
    for content in contents:
        frames += node._assembler.add(content, 0)
    (frame,) = frames
    samples = frame_samples(frame.codes, config).ravel()
    outside = {4065: 223 + 120j, 3293: -90 - 615j, 415: -88 + 193j, 1255: 366 - 21j, 671: -55 + 205j}
    assert {at: complex(samples[at]) for at in outside} == outside
    beams, node = played(path, contents, lambda _, beams: beams == 8)
    assert node._assembler.counts.placed == 12
    expected = row_beams(frame_samples(frame.codes, config), radar_setup(config), array_params(config))
    np.testing.assert_array_equal(np.stack([beam.samples for beam in beams]), expected)
