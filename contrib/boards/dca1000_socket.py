"""The DCA1000 capture card over Ethernet: its command port, and a thread that takes its datagrams.

A command is header, code, length, content and footer; the card answers header, code, status and footer, from whatever
port. It sends samples to the addresses in its own memory, 192.168.33.30 unless that was changed, so this end binds
them: the one socket of the project, beside the link's, that other machines reach. Only datagrams of the card's address
are taken, and they are numbers: nothing that they hold is run or unpacked. Codes and layouts are those of recorded
traffic of a card and of the maker's documents; no card has confirmed this driver.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import socket
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass

import msgspec

from contrib.boards.dca1000_packets import DATAGRAM_BYTES

_LOG = logging.getLogger(__name__)

HEADER, FOOTER = 0xA55A, 0xEEAA
#: Codes of commands.
RESET_FPGA, CONFIGURE_FPGA, START_RECORD, STOP_RECORD = 0x01, 0x03, 0x05, 0x06
CONNECT, REPORT, CONFIGURE_PACKETS, READ_VERSION = 0x09, 0x0A, 0x0B, 0x0E
_COMMAND, _ANSWER = struct.Struct("<HHH"), struct.Struct("<HHHH")
#: Raw samples, captured from the lanes, over Ethernet, 16 bits; the recording ends after so many seconds without any.
_RAW, _CAPTURE, _ETHERNET, _BITS_16, _SILENCE_S = 1, 1, 2, 3, 30
_LANES_CODE = {4: 1, 2: 2}
#: As the maker's tool sets it, for datagrams of 1466 bytes; delays count in 8 ns.
_PACKET_SIZE, _DELAYS_PER_US = 1470, 125
#: Bits of a report that the card sends unasked.
REPORTS = (
    "no samples on the lanes", "no header", "EEPROM failure", "SD card detected", "SD card removed", "SD card full",
    "mode not configured", "memory full", "recording completed", "lane buffer full", "playback completed",
    "playback out of sequence",
)  # fmt: skip
#: Reports after which nothing more comes of a recording.
ENDED = frozenset({"no samples on the lanes", "recording completed", "mode not configured", "memory full"})
#: The card answers within this, or counts as absent.
TIMEOUT_S = 1.0
#: Datagrams that may wait between thread and node, about 48 MB; more are dropped and counted.
QUEUE_DATAGRAMS = 1 << 15
#: Asked of the kernel, which grants `net.core.rmem_max`.
_SOCKET_BYTES = 1 << 25
_WAKE_S = 0.1


#: Ports of the card as it is delivered, and the rest between its datagrams.
COMMAND_PORT, DATA_PORT = 4096, 4098
PACKET_DELAY_US = 25.0


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Addresses of both ends, as the card's memory has them."""

    host_address: str = "192.168.33.30"
    card_address: str = "192.168.33.180"

    def __post_init__(self) -> None:
        for name in ("host_address", "card_address"):
            try:
                address = ipaddress.IPv4Address(getattr(self, name))
            except ValueError:
                raise ValueError(f"card.{name} must be an IPv4 address, got {getattr(self, name)!r}") from None
            if address.is_unspecified or address.is_multicast or address == ipaddress.IPv4Address("255.255.255.255"):
                raise ValueError(f"card.{name} must be the address of one interface, got {getattr(self, name)!r}")


def command(code: int, content: bytes = b"") -> bytes:
    """Return the bytes of a command."""
    return _COMMAND.pack(HEADER, code, len(content)) + content + struct.pack("<H", FOOTER)


def parse_answer(content: bytes) -> tuple[int, int]:
    """Return code and status of an answer or report. Raises `ValueError` for any other datagram."""
    if len(content) == _ANSWER.size:
        header, code, status, footer = _ANSWER.unpack(content)
        if (header, footer) == (HEADER, FOOTER):
            return code, status
    raise ValueError(f"answer must be {_ANSWER.size} bytes from {HEADER:#x} to {FOOTER:#x}, got {content[:16].hex()}")


def reports(status: int) -> list[str]:
    """Return the words of a report's bits."""
    return [words for bit, words in enumerate(REPORTS) if status >> bit & 1]


@dataclass
class LinkCounts:
    """Datagrams that were taken; those of other senders, and those for which the queue had no room."""

    taken: int = 0
    foreign: int = 0
    overrun: int = 0


class Card:
    """One card: `open` begins a recording, `take` returns what came since, `close` ends it."""

    def __init__(self, params: Params, lanes: int) -> None:
        self._params = params
        self._configuration = bytes((_RAW, _LANES_CODE[lanes], _CAPTURE, _ETHERNET, _BITS_16, _SILENCE_S))
        self._commands: socket.socket | None = None
        self._receiver: _Receiver | None = None
        self.counts = LinkCounts()

    def open(self) -> None:
        """Configure the card and begin a recording; again after a loss.

        Raises `ConnectionError` if it does not answer or an address is not this machine's, `ValueError` if it refuses.
        """
        params = self._params
        delay = round(PACKET_DELAY_US * _DELAYS_PER_US)
        self._commands = self._bound(COMMAND_PORT)
        self._receiver = _Receiver(self._bound(DATA_PORT), params.card_address, self.counts)
        self._ask(CONNECT)
        self._ask(RESET_FPGA)
        version = self._ask(READ_VERSION)
        self._ask(CONFIGURE_FPGA, self._configuration)
        self._ask(CONFIGURE_PACKETS, struct.pack("<HHH", _PACKET_SIZE, delay, 0))
        self._receiver.discard()
        self._ask(START_RECORD)
        _LOG.info("card at %s, FPGA %d.%d", params.card_address, version & 0x7F, version >> 7 & 0x7F)

    def take(self) -> list[tuple[bytes, int]]:
        """Return datagrams in order of arrival, each with its time on the monotonic clock."""
        return [] if self._receiver is None else self._receiver.take()

    def reports(self) -> list[str]:
        """Return the words of reports that came unasked."""
        words: list[str] = []
        while (answer := self._answer(0.0)) is not None:
            code, status = answer
            words += reports(status) if code == REPORT else []
        return words

    def close(self) -> None:
        """End the recording, as far as the card still answers, and close both sockets."""
        commands, receiver = self._commands, self._receiver
        if commands is not None:
            with contextlib.suppress(OSError, ValueError):
                self._ask(STOP_RECORD)
            commands.close()
        if receiver is not None:
            receiver.close()
        self._commands = self._receiver = None

    def _bound(self, port: int) -> socket.socket:
        """Return a UDP socket on this end's address."""
        address = self._params.host_address
        bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)
            bound.bind((address, port))
        except OSError as error:
            bound.close()
            raise ConnectionError(
                f"dca1000: {address} port {port} cannot be used ({error.strerror}): give the interface to the card "
                "that address, and close other programs that capture"
            ) from None
        return bound

    def _ask(self, code: int, content: bytes = b"") -> int:
        """Send a command and return the status of its answer, which must be 0 for all but a version."""
        assert self._commands is not None
        params = self._params
        where = f"dca1000: card at {params.card_address}"
        try:
            self._commands.sendto(command(code, content), (params.card_address, COMMAND_PORT))
        except OSError as error:
            raise ConnectionError(f"{where} cannot be reached ({error.strerror}): check cable and address") from None
        end_s = time.monotonic() + TIMEOUT_S
        while (left_s := end_s - time.monotonic()) > 0.0:
            answer = self._answer(left_s)
            if answer is not None and answer[0] == code:
                if answer[1] and code != READ_VERSION:
                    raise ValueError(f"{where} refuses command {code:#04x}, status must be 0, got {answer[1]}")
                return answer[1]
        raise ConnectionError(f"{where} does not answer command {code:#04x}: check power, cable and addresses")

    def _answer(self, timeout_s: float) -> tuple[int, int] | None:
        """Return code and status of the card's next answer; None if none came in time, or a foreign datagram."""
        if self._commands is None:
            return None
        self._commands.settimeout(timeout_s)
        try:
            content, (address, _) = self._commands.recvfrom(DATAGRAM_BYTES)
        except OSError:
            return None
        with contextlib.suppress(ValueError):
            return parse_answer(content) if address == self._params.card_address else None
        return None


class _Receiver:
    """A thread that empties a socket into a queue, so that the kernel's small buffer never waits for the node."""

    def __init__(self, source: socket.socket, card_address: str, counts: LinkCounts) -> None:
        self._source, self._card_address, self._counts = source, card_address, counts
        self._waiting: deque[tuple[bytes, int]] = deque()
        self._ends = False
        # one call of the kernel a datagram: a timeout of Python's would be two
        seconds, microseconds = divmod(round(1e6 * _WAKE_S), 1_000_000)
        source.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", seconds, microseconds))
        self._thread = threading.Thread(target=self._run, name="dca1000", daemon=True)
        self._thread.start()

    def take(self) -> list[tuple[bytes, int]]:
        """Return what has come since, in order."""
        waiting = self._waiting
        return [waiting.popleft() for _ in range(len(waiting))]

    def discard(self) -> None:
        """Forget what has come: the rest of a recording before."""
        self._waiting.clear()

    def close(self) -> None:
        """End thread and socket."""
        self._ends = True
        self._thread.join()
        self._source.close()

    def _run(self) -> None:
        receive, counts, waiting = self._source.recvfrom, self._counts, self._waiting
        while not self._ends:
            try:
                # a byte more than any datagram of this mode: a longer one does not pass for one cut to size
                content, (address, _) = receive(DATAGRAM_BYTES + 1)
            except OSError:
                continue
            if address != self._card_address:
                counts.foreign += 1
            elif len(waiting) >= QUEUE_DATAGRAMS:
                counts.overrun += 1
            else:
                waiting.append((content, time.monotonic_ns()))
                counts.taken += 1
