"""A mapping's quantity matched with its DBC: the factor to SI units, the range of each signal, and the assumptions."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from models.vehicle.can_mapping import DbcRange, QuantityRule
from models.vehicle.end_to_end import signal_of
from models.vehicle.signal_units import SI_NAMES, Dimension, known_units, parse_unit

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal

#: A scale may differ from that of its unit by a calibration, such as the size of worn tyres; units differ by more.
MAX_CALIBRATION = 0.1
#: Limits in counts cover at least this share of the counts that the bits can hold.
_RAW_SHARE = 0.5


class SignalRange(NamedTuple):
    """Limits of a signal in the unit of the DBC."""

    low: float
    high: float


class Quantity:
    """The signals of one quantity, and their values in SI units; `ValueError` where mapping and DBC disagree."""

    def __init__(self, field: str, rule: QuantityRule, message: Message, dimension: Dimension) -> None:
        self.field, self.rule = field, rule
        self.signals = [signal_of(message, name, f"{field}.signals") for name in rule.signals]
        #: Notes for the reader on how the DBC was read.
        self.warnings: list[str] = []
        self.factor = self._factor(dimension)
        self._ranges = [self._range(signal) for signal in self.signals]

    def range_fault(self, index: int, value: float) -> str:
        """Return what is wrong with the value of a signal by the DBC's own range; empty if nothing is."""
        signal, (low, high) = self.signals[index], self._ranges[index]
        # limits are decimal numbers, values are multiples of the scale: within half a step they are equal
        slack = 0.5 * abs(float(signal.scale))
        if low - slack <= value <= high + slack and math.isfinite(value):
            return ""
        unit = f" {signal.unit}" if signal.unit else ""
        return f"{signal.name} = {value:g}{unit} is outside the DBC's {low:g}..{high:g}"

    def to_si(self, values: list[float], negative: bool) -> float:
        """Return the quantity in SI units from the values of its signals."""
        rule = self.rule
        combined = sum(values) if rule.combine == "sum" else sum(values) / len(values)
        value = rule.sign * (self.factor * combined + rule.offset)
        # adding zero gives a stationary car the speed 0, not -0
        return (-value if negative else value) + 0.0

    def from_si(self, value: float) -> tuple[list[float], bool]:
        """Return the signals' values for a quantity, the last one the remainder, and the need of `negative_while`."""
        rule = self.rule
        negative = rule.negative_while is not None and value < 0.0
        combined = (rule.sign * (-value if negative else value) - rule.offset) / self.factor
        if rule.combine == "sum":
            return self._parts(combined), negative
        return [combined for _ in self.signals], negative

    def _parts(self, combined: float) -> list[float]:
        """Return values of the signals whose sum is `combined`, as far as the bits of the last one permit."""
        parts = []
        for signal in self.signals[:-1]:
            scale, offset = float(signal.scale), float(signal.offset)
            parts.append(scale * round((combined - offset) / scale) + offset)
            combined -= parts[-1]
        last = self.signals[-1]
        low, high = (-math.inf, math.inf) if last.is_float or not parts else _scaled(last, _raw_limits(last))
        return [*parts, min(max(combined, low), high)]

    def _factor(self, dimension: Dimension) -> float:
        """Return the factor from the signals' unit to SI; `ValueError` if no file states the unit, or two disagree."""
        field, rule = self.field, self.rule
        units = dict.fromkeys(signal.unit or "" for signal in self.signals)
        if rule.unit is None and len({parse_unit(text) or text for text in units}) > 1:
            raise ValueError(f"{field}.signals: must be of one unit, the DBC has {' and '.join(map(repr, units))}")
        in_dbc = next(iter(units))
        unit = parse_unit(in_dbc if rule.unit is None else rule.unit)
        if unit is None:
            if rule.scale is None:
                says = f"the unit {in_dbc!r}" if in_dbc else "no unit"
                spellings = known_units(dimension)
                raise ValueError(
                    f"{field}.unit: must be given, the DBC states {says} for {rule.signals[0]}; known are {spellings}"
                )
            return rule.scale
        if unit.dimension is not dimension:
            whose = f"{rule.signals[0]} is" if rule.unit is None else "is given"
            raise ValueError(
                f"{field}.unit: must be of {known_units(dimension)}; {whose} in {unit.name}, which is no {dimension}"
            )
        self._compare(in_dbc, unit.to_si)
        return self._calibrated(unit.name, unit.to_si, SI_NAMES[dimension])

    def _compare(self, in_dbc: str, to_si: float) -> None:
        """Warn if the mapping's unit is not that of the DBC."""
        unit = parse_unit(in_dbc)
        if self.rule.unit is not None and unit is not None and not math.isclose(unit.to_si, to_si):
            self.warnings.append(
                f"{self.field}.unit: {self.rule.unit} is taken for {', '.join(self.rule.signals)}, "
                f"the DBC says {in_dbc}"
            )

    def _calibrated(self, unit: str, to_si: float, si_name: str) -> float:
        """Return the mapping's scale if it has one; `ValueError` if that is no calibration but another unit."""
        scale = self.rule.scale
        if scale is None:
            return to_si
        if abs(abs(scale) / to_si - 1.0) > MAX_CALIBRATION:
            raise ValueError(
                f"{self.field}.scale: must be within 10 % of {to_si:.9g}, which makes {unit} {si_name}, got {scale!r}; "
                "leave scale out, or state the true unit"
            )
        return scale

    def _range(self, signal: Signal) -> SignalRange:
        """Return the effective limits of a signal."""
        stated = SignalRange(
            -math.inf if signal.minimum is None else float(signal.minimum),
            math.inf if signal.maximum is None else float(signal.maximum),
        )
        match self.rule.dbc_range:
            case DbcRange.IGNORE:
                return SignalRange(-math.inf, math.inf)
            case DbcRange.PHYSICAL:
                return stated
            case DbcRange.RAW:
                return self._counted_range(signal, stated)
            case DbcRange.AUTO:
                return self._judged_range(signal, stated)

    def _counted_range(self, signal: Signal, stated: SignalRange) -> SignalRange:
        counts = _raw_limits(signal)
        if signal.is_float or stated.low > counts.high or stated.high < counts.low:
            raise ValueError(
                f"{self.field}.dbc_range: must not be raw, {stated.low:g}..{stated.high:g} of the DBC are no counts of "
                f"the {signal.length} bits of {signal.name}"
            )
        return raw_range(signal, stated)

    def _judged_range(self, signal: Signal, stated: SignalRange) -> SignalRange:
        if not is_in_counts(signal, stated):
            return stated
        taken = raw_range(signal, stated)
        self.warnings.append(
            f"{self.field}.signals: the DBC's range {stated.low:g}..{stated.high:g} of {signal.name} is taken as raw "
            f"counts, {taken.low:g}..{taken.high:g} {signal.unit or ''}".rstrip()
            + f"; {self.field}.dbc_range: physical overrules this"
        )
        return taken


def is_in_counts(signal: Signal, stated: SignalRange) -> bool:
    """Return whether the limits of a signal are those of its raw counts rather than of its scaled values.

    They cover half of the counts at least, and as scaled values would be wrong or exactly the ends of the counts.
    """
    if signal.is_float or (signal.scale == 1 and signal.offset == 0) or not all(map(math.isfinite, stated)):
        return False
    counts, scaled = _raw_limits(signal), _scaled(signal, _raw_limits(signal))
    shared = min(stated.high, counts.high) - max(stated.low, counts.low)
    if shared < _RAW_SHARE * (counts.high - counts.low):
        return False
    step = abs(float(signal.scale))
    reaches_out = stated.low < scaled.low - step or stated.high > scaled.high + step
    cuts_off = stated.low > scaled.low + step or stated.high < scaled.high - step
    return cuts_off and (reaches_out or stated == counts)


def raw_range(signal: Signal, counts: SignalRange) -> SignalRange:
    """Return limits in raw counts as scaled values; counts beyond the bits do not limit."""
    limits = _raw_limits(signal)
    clipped = SignalRange(max(counts.low, limits.low), min(counts.high, limits.high))
    return _scaled(signal, clipped)


def _raw_limits(signal: Signal) -> SignalRange:
    if signal.is_signed:
        half = 2.0 ** (signal.length - 1)
        return SignalRange(-half, half - 1.0)
    return SignalRange(0.0, 2.0**signal.length - 1.0)


def _scaled(signal: Signal, counts: SignalRange) -> SignalRange:
    scale, offset = float(signal.scale), float(signal.offset)
    ends = sorted((scale * counts.low + offset, scale * counts.high + offset))
    return SignalRange(*ends)
