"""The card's command port and its datagrams on the loopback, against a card that stands in for one."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Iterator

import msgspec
import pytest

from contrib.boards import dca1000_socket as dca1000
from contrib.boards.dca1000_packets import DATAGRAM_BYTES
from tests.captures import DATA, needs
from tests.contrib.boards.dca1000_stand_in import CARD, HOST, StandInCard, datagrams_of

PCAP = DATA / "dca1000_pcap"


def until(holds: Callable[[], bool], limit_s: float = 20.0) -> None:
    """Wait for what threads and sockets of another side do; its end, not its time, is the test."""
    end_s = time.monotonic() + limit_s
    while not holds():
        assert time.monotonic() < end_s, "it never came"
        time.sleep(0.005)


def udp_payloads(capture: bytes) -> list[tuple[int, bytes]]:
    """Destination port and payload of each UDP datagram of a classic little-endian pcap over Ethernet and IPv4."""
    out, at = [], 24
    while at < len(capture):
        (length,) = struct.unpack_from("<I", capture, at + 8)
        frame = capture[at + 16 : at + 16 + length]
        udp = frame[14 + 4 * (frame[14] & 15) :]
        _, port, size, _ = struct.unpack_from(">HHHH", udp)
        out.append((port, udp[8:size]))
        at += 16 + length
    return out


@pytest.fixture
def stand_in() -> Iterator[StandInCard]:
    card = StandInCard(datagrams_of(bytes(range(256)) * 20))
    yield card
    card.close()


@pytest.fixture
def card(stand_in: StandInCard) -> Iterator[dca1000.Card]:
    opened = dca1000.Card(stand_in.params, 2)
    yield opened
    opened.close()


def received(card: dca1000.Card, count: int) -> list[bytes]:
    """So many datagrams."""
    out: list[bytes] = []
    until(lambda: bool(out.extend(content for content, _ in card.take())) or len(out) >= count)
    return out


def test_a_recording_is_begun_as_the_card_expects_it(stand_in: StandInCard, card: dca1000.Card) -> None:
    """Order and contents of the commands; two lanes are 2, four are 1; 25 us are 3125 counts of 8 ns."""
    card.open()
    assert stand_in.commands == [
        (dca1000.CONNECT, b""),
        (dca1000.RESET_FPGA, b""),
        (dca1000.READ_VERSION, b""),
        (dca1000.CONFIGURE_FPGA, bytes([1, 2, 1, 2, 3, 30])),
        (dca1000.CONFIGURE_PACKETS, bytes.fromhex("be05350c0000")),
        (dca1000.START_RECORD, b""),
    ]
    assert received(card, 4) == stand_in.datagrams
    card.close()
    assert stand_in.commands[-1] == (dca1000.STOP_RECORD, b"")
    assert dca1000.Card(stand_in.params, 4)._configuration == bytes([1, 1, 1, 2, 3, 30])


def test_a_card_can_be_opened_again(stand_in: StandInCard, card: dca1000.Card) -> None:
    for _ in range(2):
        card.open()
        assert received(card, 4) == stand_in.datagrams
        card.close()


@pytest.mark.parametrize(
    ("code", "status", "error", "rule"),
    [
        (dca1000.CONNECT, None, ConnectionError, f"card at {CARD} does not answer command 0x09: check power, cable"),
        (dca1000.START_RECORD, None, ConnectionError, "does not answer command 0x05"),
        (dca1000.CONFIGURE_FPGA, 1, ValueError, "refuses command 0x03, status must be 0, got 1"),
    ],
)
def test_a_card_that_does_not_answer_or_refuses(
    monkeypatch: pytest.MonkeyPatch,
    stand_in: StandInCard,
    card: dca1000.Card,
    code: int,
    status: int | None,
    error: type[Exception],
    rule: str,
) -> None:
    monkeypatch.setattr(dca1000, "TIMEOUT_S", 0.2)
    stand_in.status[code] = status
    with pytest.raises(error, match=rule):
        card.open()
    card.close()
    stand_in.status[code] = 0
    monkeypatch.setattr(dca1000, "TIMEOUT_S", 5.0)
    card.open()


def test_an_address_that_is_not_ours_or_a_port_in_use(stand_in: StandInCard) -> None:
    away = msgspec.structs.replace(stand_in.params, host_address="192.0.2.1")
    with pytest.raises(ConnectionError, match=r"dca1000: 192\.0\.2\.1 port \d+ cannot be used \(Cannot assign"):
        dca1000.Card(away, 2).open()
    first, second = dca1000.Card(stand_in.params, 2), dca1000.Card(stand_in.params, 2)
    first.open()
    with pytest.raises(ConnectionError, match=r"cannot be used \(Address already in use\)"):
        second.open()
    second.close()
    assert received(first, 4) == stand_in.datagrams
    first.close()


def test_others_are_not_heard(stand_in: StandInCard, card: dca1000.Card) -> None:
    """Datagrams and answers of another address: the first are counted, the second ignored."""
    card.open()
    assert received(card, 4) == stand_in.datagrams
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(stand_in.datagrams[0], (HOST, dca1000.DATA_PORT))
        other.sendto(struct.pack("<HHHH", 0xA55A, 0x0A, 1, 0xEEAA), (HOST, dca1000.COMMAND_PORT))
    until(lambda: card.counts.foreign == 1)
    assert card.take() == []
    assert card.reports() == []


def test_reports_come_in_words(stand_in: StandInCard, card: dca1000.Card) -> None:
    card.open()
    stand_in.report(0x100 | 0x001)
    words: list[str] = []
    until(lambda: bool(words.extend(card.reports())) or bool(words))
    assert words == ["no samples on the lanes", "recording completed"]
    assert set(words) <= dca1000.ENDED


def test_a_queue_that_nobody_empties_has_an_end(
    monkeypatch: pytest.MonkeyPatch, stand_in: StandInCard, card: dca1000.Card
) -> None:
    monkeypatch.setattr(dca1000, "QUEUE_DATAGRAMS", 3)
    card.open()
    until(lambda: card.counts.overrun == 1)
    assert [content for content, _ in card.take()] == stand_in.datagrams[:3]


def test_longer_datagrams_do_not_pass_for_ours(stand_in: StandInCard, card: dca1000.Card) -> None:
    stand_in.datagrams = [bytes(DATAGRAM_BYTES + 100)]
    card.open()
    assert len(received(card, 1)[0]) == DATAGRAM_BYTES + 1


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"host_address": "a.example"}, "card.host_address must be an IPv4 address, got 'a.example'"),
        ({"host_address": "0.0.0.0"}, "card.host_address must be the address of one interface, got '0.0.0.0'"),
        ({"card_address": "255.255.255.255"}, "card.card_address must be the address of one interface"),
        ({"card_address": "224.0.0.1"}, "card.card_address must be the address of one interface"),
    ],
)
def test_wrong_addresses_are_named(change: dict[str, object], rule: str) -> None:
    with pytest.raises(ValueError, match=rule):
        dca1000.Params(**change)  # type: ignore[arg-type]


@pytest.mark.parametrize("content", [b"", b"\x5a\xa5", bytes(8), bytes(9), bytes.fromhex("5aa509000000aaef")])
def test_answers_of_another_kind_are_refused(content: bytes) -> None:
    with pytest.raises(ValueError, match="answer must be 8 bytes from 0xa55a to 0xeeaa"):
        dca1000.parse_answer(content)


@needs(PCAP)
def test_answers_of_a_real_card() -> None:
    """Recorded: ten commands answered, FPGA 2.8; at the end of a recording the report that it is completed."""
    answers = [dca1000.parse_answer(content) for _, content in udp_payloads((PCAP / "test_cmd.pcap").read_bytes())]
    assert [code for code, _ in answers] == [0x01, 0x02, 0x05, 0x06, 0x0B, 0x03, 0x04, 0x09, 0x0A, 0x0E]
    assert answers[-1] == (dca1000.READ_VERSION, 2 | 8 << 7)
    frame = udp_payloads((PCAP / "test_one_frame.pcap").read_bytes())
    *opened, ended = [dca1000.parse_answer(content) for port, content in frame if port == 4096]
    order = [dca1000.CONNECT, dca1000.RESET_FPGA, dca1000.CONFIGURE_FPGA, dca1000.CONFIGURE_PACKETS]
    assert opened == [(code, 0) for code in (*order, dca1000.START_RECORD)]
    assert dca1000.reports(ended[1]) == ["recording completed"]
