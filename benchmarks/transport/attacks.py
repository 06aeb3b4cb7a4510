"""Attacks on the bus of one host and on the link between two, after controls that show that the tools are sharp.

Each row: what was tried how often, how often it was accepted (0, unless it is a control or the border of trust), what
the victim did or said, and whether its good peer is served afterwards. Exit code 1 where anything was accepted that
must not be, or a good peer is not served. What another user may try on the bus needs root, to become that user.
Usage: python -m benchmarks.transport.attacks [--tries 5] [--flood 1000] [--subscriptions 100000]
       [--hangups 5000] [--seed 0] [--json]
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable

from benchmarks.transport import attacks_hangup, attacks_ipc, attacks_link
from benchmarks.transport.net import Row
from mirrorwave.plots.markdown import table

_HEAD = ("victim", "attack", "tried", "accepted", "what it did or said", "good peer served")


def markdown(rows: Iterable[Row]) -> str:
    """The rows as a table."""
    lines = []
    for row in rows:
        accepted = f"{row.accepted} (meant to)" if row.by_design else str(row.accepted)
        served = "yes" if row.serves else "NO"
        lines.append((row.victim, row.attack, row.tried, accepted, row.said.replace("|", "/"), served))
    return "\n".join(table(_HEAD, lines))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tries", type=int, default=5)
    parser.add_argument("--flood", type=int, default=1000, help="half-open connections")
    parser.add_argument("--subscriptions", type=int, default=100_000, help="of one allowed peer; messages upwards too")
    parser.add_argument("--hangups", type=int, default=5000, help="peers that leave at once, of each kind of socket")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    rows = [
        *attacks_ipc.rows(arguments.tries),
        *attacks_hangup.rows(arguments.hangups, arguments.seed),
        *attacks_link.rows(
            arguments.tries, arguments.seed, arguments.flood, arguments.subscriptions, arguments.hangups
        ),
    ]
    print(json.dumps([row._asdict() for row in rows]) if arguments.json else markdown(rows))
    return int(any(row.is_defeat for row in rows))


if __name__ == "__main__":
    sys.exit(main())
