"""What waits for one client of the Foxglove bridge: bounded in bytes, the oldest left out and counted."""

from __future__ import annotations

import asyncio
from typing import Any

from contrib.foxglove.foxglove_server import MAX_QUEUE_BYTES, _Client

MIB = 1 << 20


class _Socket:
    """A websocket that takes whatever it is sent."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    async def send(self, message: dict[str, Any]) -> None:
        self.sent.append(message.get("bytes") or message.get("text"))


def test_a_client_that_does_not_read_keeps_the_newest_32_mebibytes() -> None:
    """Of 40 messages of 1 MiB and a head of 13 bytes 31 fit; each that is sent makes room for one more."""
    assert MAX_QUEUE_BYTES == 32 * MIB
    socket = _Socket()
    client = _Client(socket, [], 1, lambda: None)  # type: ignore[arg-type]
    client.subscriptions[1] = 7
    for number in range(40):
        client.offer(1, number, bytes([number]) * MIB)
    assert (len(client._queue), client._dropped) == (31, 9)
    assert client._queue[0][-1] == 9

    asyncio.run(client._send_next())
    assert [message[-1] for message in socket.sent] == [9]
    # the note of what was left out has taken the free place; it is read too
    while client._queue:
        asyncio.run(client._send_next())
    for number in range(31):
        client.offer(1, number, bytes(MIB))
    assert (len(client._queue), client._dropped, client._queued_bytes) == (31, 0, 31 * (MIB + 13))
