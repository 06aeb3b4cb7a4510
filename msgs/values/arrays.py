"""What the fields of a message may hold, by their annotations: `msgspec.Meta` for numbers, `Array` for arrays."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from functools import cache
from operator import attrgetter
from typing import Annotated, Any, ClassVar, NamedTuple, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from msgspec import Meta

#: Name of one of several sensors.
_SENSOR_NAME, MAX_SENSOR_NAME = re.compile(r"[a-z][a-z0-9_]*"), 20
#: Permitted dtypes. No object, no structured, no datetime dtype: nothing that could carry code or pointers.
DTYPES = frozenset({"|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8", "<c8", "<c16"})
MAX_NDIM = 6
#: Stamps beyond this, 146 years, fit no message: neither two of them nor their difference would fit 64 bits.
MAX_STAMP_NS = 1 << 62
#: Relative error that a covariance may have of rounding.
COVARIANCE_ROUNDING = 1e-6
MAX_VARIANCE = 1e12

#: Nanoseconds of acquisition. Negative on the clock of a host that started later than the one that measured.
StampNs = Annotated[int, Meta(ge=-MAX_STAMP_NS, le=MAX_STAMP_NS)]
Count = Annotated[int, Meta(ge=0, le=1 << 62)]
#: A score, a share or a probability.
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
#: A coordinate or a distance with its sign; beyond any sensor, and within it every derived number is a finite double.
Metres = Annotated[float, Meta(ge=-1e6, le=1e6)]
LengthM = Annotated[float, Meta(ge=0.0, le=1e6)]
AzimuthRad = Annotated[float, Meta(ge=-math.pi, le=math.pi)]
#: An angle that may have turns in it.
AngleRad = Annotated[float, Meta(ge=-1e3, le=1e3)]
#: In dB, dBm or dBsm: no receiver, target or transmitter lies beyond.
LevelDb = Annotated[float, Meta(ge=-300.0, le=300.0)]
#: In both directions; beyond any vehicle or road user.
MAX_SPEED_MPS = 1e3
SpeedMps = Annotated[float, Meta(ge=-MAX_SPEED_MPS, le=MAX_SPEED_MPS)]
StandardDeviation = Annotated[float, Meta(ge=0.0, le=1e6)]
#: A duration or an age.
Seconds = Annotated[float, Meta(ge=0.0, le=1e10)]
Milliseconds = Annotated[float, Meta(ge=0.0, le=1e13)]
Variance = Annotated[float, Meta(ge=0.0, le=MAX_VARIANCE)]
#: Row-major 2x2, positive semi-definite.
Covariance = tuple[
    tuple[Variance, Annotated[float, Meta(ge=-MAX_VARIANCE, le=MAX_VARIANCE)]],
    tuple[Annotated[float, Meta(ge=-MAX_VARIANCE, le=MAX_VARIANCE)], Variance],
]


class Array(NamedTuple):
    """Rule of an array: dtype ("<c8"), shape, and the range of its numbers, ends included.

    A length is a number, None for any, or the name of a field of the same message: its number, or an array's length.
    `or_nan` lets NaN say "not measured". `covariances` are 2x2 matrices, positive semi-definite.
    """

    dtype: str
    shape: tuple[int | str | None, ...]
    least: float = -math.inf
    greatest: float = math.inf
    or_nan: bool = False
    covariances: bool = False


class Checked(msgspec.Struct, frozen=True, kw_only=True):
    """Base of messages and their parts: `ValueError` for a field that breaks the rule of its annotation."""

    #: Name of the message in errors.
    label: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for name, check in _checks(type(self)):
            check(self, getattr(self, name))


_COVARIANCE_RULE = f"must have variances within 0..{MAX_VARIANCE:g} and a correlation within -1..1"
_Check = Callable[[Any, Any], None]


@cache
def _checks(kind: type[Checked]) -> tuple[tuple[str, _Check], ...]:
    """Return the fields of a type that have rules, each with the check of its value."""
    hints = get_type_hints(kind, include_extras=True)
    checks = ((name, _check(f"{kind.label}.{name}", hints[name])) for name in kind.__struct_fields__)
    return tuple((name, check) for name, check in checks if check is not None)


def _check(name: str, hint: Any) -> _Check | None:
    """Return the check of a type, None where it has no rule."""
    arguments = get_args(hint)
    if hint == Covariance:
        return lambda _, value: _require_covariance(name, value)
    if get_origin(hint) is Annotated:
        rule = next((note for note in arguments[1:] if isinstance(note, Meta | Array)), None)
        if isinstance(rule, Array):
            return lambda message, value: _require_numbers(name, value, rule, message)
        return None if rule is None else _range_check(name, rule)
    if type(None) in arguments:
        inner = next(_check(name, option) for option in arguments if option is not type(None))
        return inner and (lambda message, value: None if value is None else inner(message, value))
    if get_origin(hint) is tuple:
        inners = [_check(name, argument) for argument in arguments if argument is not Ellipsis]
        first = inners[0] if inners else None
        if first is None:
            return None
        # all items of a tuple have one rule here, whether their number is fixed or not
        return _each(first)
    return None


def _each(check: _Check) -> _Check:
    def each(message: Any, values: Any) -> None:
        for value in values:
            check(message, value)

    return each


def limits_of(hint: Any) -> str:
    """Return the range that a type allows, as a sentence; empty where it has none, or its parts have."""
    options = [option for option in get_args(hint) if option is not type(None)]
    if type(None) in get_args(hint) and len(options) == 1:
        return limits_of(options[0])
    rule = next((note for note in options[1:] if isinstance(note, Meta | Array)), None)
    match rule:
        case Array(covariances=True):
            return "Positive semi-definite."
        case Array(least=low, greatest=high, or_nan=or_nan) if high < math.inf:
            return f"{_shortest(low)}..{_shortest(high)}{' or NaN' if or_nan else ''}."
        case Meta(ge=low, le=high) if low is not None and high is not None:
            return f"{_shortest(low)}..{_shortest(high)}."
        case Meta(gt=low, le=high) if low is not None and high is not None:
            return f"Above {low:g}, at most {high:g}."
    return ""


def _shortest(limit: float) -> str:
    return f"{'-' * (limit < 0)}2^62" if abs(limit) == MAX_STAMP_NS else f"{limit:g}"


def _range_check(name: str, rule: Meta) -> _Check | None:
    low = rule.ge if rule.ge is not None else rule.gt
    high = rule.le
    if low is None or high is None:
        return None
    is_open = rule.gt is not None

    def check(_: Any, value: float) -> None:
        # NaN is in no range
        if not low <= value <= high or (is_open and value == low):
            end = (
                f"more than {low:g} and at most {high:g}" if is_open else f"within {_shortest(low)}..{_shortest(high)}"
            )
            raise ValueError(f"{name} must be {end}, got {value!r}")

    return check


def _require_numbers(name: str, array: np.ndarray, rule: Array, message: Any) -> None:
    """Raise `ValueError` naming the field unless an array keeps its rule; complex numbers must be finite."""
    lengths = (_length(message, length) if isinstance(length, str) else length for length in rule.shape)
    require_array(name, array, rule.dtype, tuple(lengths))
    if rule.covariances:
        require_covariances(name, array)
    elif rule.dtype == "<c8":
        _require_finite(name, array)
    elif rule.greatest < math.inf and array.size:
        require_range(name, array, rule.least, rule.greatest, rule.or_nan)


def _length(message: Any, path: str) -> int:
    value = attrgetter(path)(message)
    return value if isinstance(value, int) else len(value)


def require_range(name: str, array: np.ndarray, least: float, greatest: float, or_nan: bool = False) -> None:
    """Raise `ValueError` naming the field unless all numbers, at least one, lie in range or are permitted NaN."""
    low, high = (np.fmin.reduce(array, None), np.fmax.reduce(array, None)) if or_nan else (array.min(), array.max())
    if (least <= low and high <= greatest) or (or_nan and np.isnan(low)):
        return
    bad = low if not least <= low else high
    unless = " or NaN" if or_nan else ""
    raise ValueError(f"{name} must be within {_shortest(least)}..{_shortest(greatest)}{unless}, got {bad.item()!r}")


def require_covariances(name: str, covariance: np.ndarray) -> None:
    """Raise `ValueError` naming the field unless matrices [..., 2, 2] are finite and, within rounding, covariances."""
    first, cross, other, second = (covariance[..., i, j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    # the root of each: the product of two variances may leave the doubles
    with np.errstate(invalid="ignore"):
        largest = np.sqrt(first) * np.sqrt(second)
        tolerance = COVARIANCE_ROUNDING * largest
        good = (np.maximum(first, second) <= MAX_VARIANCE) & (np.abs(cross) <= largest + tolerance)
        good &= np.abs(cross - other) <= tolerance
    if not np.all(good):
        bad = covariance[np.flatnonzero(~good)[0]] if covariance.ndim > 2 else covariance
        raise ValueError(f"{name} {_COVARIANCE_RULE}, got {bad.tolist()}")


def _require_covariance(name: str, covariance: Covariance) -> None:
    """Do the same with one matrix of plain numbers, in a tenth of the time."""
    (first, cross), (other, second) = covariance
    if 0.0 <= first <= MAX_VARIANCE and 0.0 <= second <= MAX_VARIANCE:
        largest = math.sqrt(first) * math.sqrt(second)
        tolerance = COVARIANCE_ROUNDING * largest
        if abs(cross) <= largest + tolerance and abs(cross - other) <= tolerance:
            return
    raise ValueError(f"{name} {_COVARIANCE_RULE}, got {covariance}")


def require_array(name: str, array: np.ndarray, dtype: str, shape: tuple[int | None, ...]) -> None:
    """Raise `ValueError` naming the field unless `array` has `dtype` ("<c8") and `shape` (None: any length)."""
    if not isinstance(array, np.ndarray):
        raise ValueError(f"{name} must be an array, got {type(array).__name__}")
    if array.dtype.str != dtype:
        raise ValueError(f"{name} must have dtype {dtype}, got {array.dtype.str}")
    fits = array.ndim == len(shape) and all(
        want is None or have == want for have, want in zip(array.shape, shape, strict=True)
    )
    if not fits:
        expected = "x".join("?" if length is None else str(length) for length in shape)
        raise ValueError(f"{name} must have shape {expected}, got {array.shape}")


def require_finite(name: str, *values: float) -> None:
    """Raise `ValueError` naming the field unless every value is finite."""
    for value in values:
        if not np.isfinite(value):
            raise ValueError(f"{name} must be finite, got {value!r}")


def _require_finite(name: str, array: np.ndarray) -> None:
    """Raise `ValueError` naming the field unless an array of complex64 is finite."""
    # a sum of squares shows each NaN and infinity, in a tenth of the time; only one that overflows is looked at closely
    flat = np.ascontiguousarray(array).reshape(-1).view(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        is_finite = math.isfinite(flat @ flat) or np.isfinite(flat).all()
    if not is_finite:
        raise ValueError(f"{name} must be finite")


def require_positive(name: str, value: float) -> None:
    """Raise `ValueError` naming the field unless `value` is finite and above zero."""
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be finite and positive, got {value!r}")


def is_sensor_name(name: str) -> bool:
    """Return whether a word can be the name of one of several sensors."""
    return bool(_SENSOR_NAME.fullmatch(name)) and len(name) <= MAX_SENSOR_NAME


def require_sensor_name(name: str) -> None:
    """Raise `ValueError` for what cannot be the name of one of several sensors: it becomes a word of its topics."""
    if not is_sensor_name(name):
        raise ValueError(
            f"a sensor's name must be of a-z, 0-9 and _, begin with a letter and have at most {MAX_SENSOR_NAME} "
            f"characters, got {name!r}"
        )


def require_within(name: str, minimum: float, maximum: float, *values: float) -> None:
    """Raise `ValueError` naming the field unless every value lies in `minimum`..`maximum`, ends included."""
    for value in values:
        if not minimum <= value <= maximum:
            raise ValueError(f"{name} must lie in {minimum:g}..{maximum:g}, got {value!r}")
