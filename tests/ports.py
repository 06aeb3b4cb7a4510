"""Ports of this machine that nobody uses: two runs of the tests must not meet."""

from __future__ import annotations

import socket


def free_udp_port() -> int:
    """A port that the kernel gave and has back: datagrams to it come from whoever is told of it alone."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        opened.bind(("", 0))
        return int(opened.getsockname()[1])
