"""What holds of every socket that these tests open."""

from __future__ import annotations

import pytest
import zmq

#: A subscription is a message to the other end, not an option.
_MAY_CHANGE = {zmq.SUBSCRIBE, zmq.UNSUBSCRIBE}


@pytest.fixture(autouse=True)
def options_are_set_before_a_socket_lives(monkeypatch: pytest.MonkeyPatch) -> None:
    """libzmq hands a changed option to its connections; where another thread tears one down, the process crashes."""
    change = zmq.Socket.set

    def checked(socket: zmq.Socket, option: int, value: object) -> None:
        is_live = bool(socket.get(zmq.LAST_ENDPOINT).rstrip(b"\0"))
        assert option in _MAY_CHANGE or not is_live, f"{option!r} is changed on a socket that is bound or connected"
        change(socket, option, value)

    monkeypatch.setattr(zmq.Socket, "set", checked)
