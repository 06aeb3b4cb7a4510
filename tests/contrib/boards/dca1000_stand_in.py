"""A capture card without hardware: answers commands on the loopback and sends a recording as datagrams.

It has an address of its own, 127.0.0.2, and the ports that a test gives it. Loss, reordering and repeats are drawn by a
seed, and `sent` says what left it.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from contrib.boards import dca1000_socket as dca1000
from contrib.boards.dca1000_packets import PAYLOAD_BYTES, datagram
from tests.ports import free_udp_port

HOST, CARD = "127.0.0.1", "127.0.0.2"
#: FPGA 2.8, as recorded traffic of a card has it.
VERSION = 2 | 8 << 7


@dataclass(frozen=True)
class Faults:
    """Shares of datagrams that are lost and repeated, and by how many others one may be overtaken."""

    lost: float = 0.0
    repeated: float = 0.0
    overtaken: float = 0.0
    seed: int = 0


def with_faults(datagrams: list[bytes], faults: Faults) -> tuple[list[bytes], int, int]:
    """Datagrams as they arrive, how many of them never do and how many come twice; the last always arrives."""
    rng = np.random.default_rng(faults.seed)
    lost = rng.random(len(datagrams)) < faults.lost
    lost[-1:] = False
    repeated = ~lost & (rng.random(len(datagrams)) < faults.repeated)
    kept = np.repeat(np.arange(len(datagrams)), 1 + repeated - lost)
    order = np.argsort(kept + rng.uniform(0.0, max(faults.overtaken, 1e-9), len(kept)), kind="stable")
    return [datagrams[at] for at in kept[order]], int(lost.sum()), int(repeated.sum())


def datagrams_of(recording: bytes) -> list[bytes]:
    """The card's datagrams of a recording, the last as short as it is left."""
    cuts = range(0, len(recording), PAYLOAD_BYTES)
    return [datagram(1 + at, cut, recording[cut : cut + PAYLOAD_BYTES]) for at, cut in enumerate(cuts)]


class StandInCard:
    """A card that waits for commands; each recording that is started sends `datagrams`.

    `taken` says how many the other side has: no more than `AHEAD` are on their way, so that a busy machine loses none.
    """

    AHEAD = 48

    def __init__(self, datagrams: list[bytes]) -> None:
        self.params = dca1000.Params(host_address=HOST, card_address=CARD)
        # others on this machine may have the card's own
        dca1000.COMMAND_PORT, dca1000.DATA_PORT = free_udp_port(), free_udp_port()
        #: Codes and contents of the commands so far.
        self.commands: list[tuple[int, bytes]] = []
        self.datagrams = datagrams
        #: Status by code; None: no answer.
        self.status: dict[int, int | None] = {dca1000.READ_VERSION: VERSION}
        self.taken: Callable[[], int] | None = None
        self._ends = threading.Event()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((CARD, dca1000.COMMAND_PORT))
        self._socket.settimeout(0.02)
        self._threads = [threading.Thread(target=self._serve, daemon=True)]
        self._threads[0].start()

    def close(self) -> None:
        self._ends.set()
        for thread in self._threads:
            thread.join()
        self._socket.close()

    def report(self, bits: int) -> None:
        """Send a report unasked."""
        content = struct.pack("<HHHH", dca1000.HEADER, dca1000.REPORT, bits, dca1000.FOOTER)
        self._socket.sendto(content, (HOST, dca1000.COMMAND_PORT))

    def _serve(self) -> None:
        while not self._ends.is_set():
            try:
                content, sender = self._socket.recvfrom(2048)
            except TimeoutError:
                continue
            header, code, length = struct.unpack_from("<HHH", content)
            (footer,) = struct.unpack_from("<H", content, 6 + length)
            assert (header, footer, len(content)) == (0xA55A, 0xEEAA, 8 + length)
            self.commands.append((code, content[6:-2]))
            status = self.status.get(code, 0)
            if status is not None:
                # from another port than it listens at, as the card does
                with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
                    other.bind((CARD, 0))
                    other.sendto(struct.pack("<HHHH", 0xA55A, code, status, 0xEEAA), sender)
            if code == dca1000.START_RECORD and status == 0:
                self._threads.append(threading.Thread(target=self._send, daemon=True))
                self._threads[-1].start()

    def _send(self) -> None:
        taken = self.taken
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as source:
            source.bind((CARD, 0))
            for at, content in enumerate(self.datagrams):
                while taken is not None and at - taken() > self.AHEAD and not self._ends.wait(0.001):
                    pass
                source.sendto(content, (HOST, dca1000.DATA_PORT))
