"""A radar of the ARS 408 kind on a bus: its frames, packed bit by bit without the DBC that they are read with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import can
import numpy as np


@dataclass(frozen=True)
class Target:
    """A target in the steps of the frames: position in 0.2 m, speed in 0.25 m/s, RCS in 0.5 dB, codes as they are."""

    number: int
    along: int
    across: int
    speed_along: int = 512
    speed_across: int = 256
    rcs: int = 128
    stds: tuple[int, int, int, int] = (16, 16, 10, 10)
    validity: int = 0

    @property
    def position_m(self) -> tuple[float, float]:
        return 0.2 * self.along - 500.0, 0.2 * self.across - 102.3

    @property
    def radial_speed_mps(self) -> float:
        x_m, y_m = self.position_m
        speed_x_mps, speed_y_mps = 0.25 * self.speed_along - 128.0, 0.25 * self.speed_across - 64.0
        return (x_m * speed_x_mps + y_m * speed_y_mps) / math.hypot(x_m, y_m)


def packed(length: int, *fields: tuple[int, int]) -> bytes:
    """Numbers of some bits each, the first in the highest bits of the first byte."""
    value = 0
    for number, bits in fields:
        assert 0 <= number < 1 << bits
        value = value << bits | number
    assert sum(bits for _, bits in fields) == 8 * length
    return value.to_bytes(length, "big")


def random_targets(count: int, seed: int) -> list[Target]:
    """Targets ahead, 1 to 250 m along and 100 m to either side, of any speed and quality."""
    rng = np.random.default_rng(seed)
    return [
        Target(
            number=number,
            along=int(rng.integers(2505, 3750)),
            across=int(rng.integers(12, 1012)),
            speed_along=int(rng.integers(0, 1024)),
            speed_across=int(rng.integers(0, 512)),
            rcs=int(rng.integers(0, 256)),
            stds=tuple(int(code) for code in rng.integers(0, 31, 4)),  # type: ignore[arg-type]
        )
        for number in range(count)
    ]


def status(near: int, far: int, counter: int) -> bytes:
    return packed(5, (near, 8), (far, 8), (counter, 16), (1, 4), (0, 4))


def general(target: Target) -> bytes:
    return packed(
        8, (target.number, 8), (target.along, 13), (0, 1), (target.across, 10), (target.speed_along, 10),
        (target.speed_across, 9), (0, 2), (1, 3), (target.rcs, 8),
    )  # fmt: skip


def quality(target: Target) -> bytes:
    along, across, speed_along, speed_across = target.stds
    return packed(
        5, (target.number, 8), (along, 5), (across, 5), (speed_along, 5), (speed_across, 5), (0, 1), (3, 3),
        (target.validity, 5), (3, 3),
    )  # fmt: skip


def object_status(count: int, counter: int) -> bytes:
    return packed(4, (count, 8), (counter, 16), (1, 4), (0, 4))


def object_general(target: Target) -> bytes:
    """The same target; lateral distances of objects begin at -204.6 m."""
    return packed(
        8, (target.number, 8), (target.along, 13), (target.across, 11), (target.speed_along, 10),
        (target.speed_across, 9), (0, 2), (1, 3), (target.rcs, 8),
    )  # fmt: skip


def object_quality(target: Target, state: int = 2) -> bytes:
    along, across, speed_along, speed_across = target.stds
    return packed(
        7, (target.number, 8), (along, 5), (across, 5), (speed_along, 5), (speed_across, 5), (1, 5), (2, 5), (3, 5),
        (0, 5), (7, 3), (state, 3), (0, 2),
    )  # fmt: skip


Frame = tuple[int, bytes]


def measurement(targets: Sequence[Target], counter: int, sensor_id: int = 0, with_quality: bool = True) -> list[Frame]:
    """Frames of one measurement, id and data: the status, all targets, all qualities."""
    shift, near = 0x10 * sensor_id, len(targets) // 2
    frames = [(0x600 + shift, status(near, len(targets) - near, counter % (1 << 16)))]
    frames += [(0x701 + shift, general(target)) for target in targets]
    return frames + [(0x702 + shift, quality(target)) for target in targets if with_quality]


def message(frame: Frame, stamp_s: float = 0.0) -> can.Message:
    return can.Message(timestamp=stamp_s, arbitration_id=frame[0], data=frame[1], is_extended_id=False)
