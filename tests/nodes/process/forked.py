"""Stands in for a node that is forked: says what it was called with, waits until it may begin, ends."""

from __future__ import annotations

import os
import sys


def main(words: list[str]) -> int:
    sys.stdout.write(f"{words[0]} of {len(sys.argv) + 1} words\n")
    sys.stdout.flush()
    os.read(0, 1)
    sys.stderr.write("begins\n")
    return 7
