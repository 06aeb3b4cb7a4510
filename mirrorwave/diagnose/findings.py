"""Findings of the doctor: what was checked, how it came out, and why."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Status(StrEnum):
    """Outcome of a check."""

    OK = "ok"
    WARNING = "warning"
    FAILED = "failed"


class Finding(NamedTuple):
    """Result of a check."""

    check: str
    status: Status
    detail: str
