"""Messages of any content their types let in, built from the types themselves, and scripts of steps made of them.

`drawn(type)` is any value of a type; `near(value)` is a good value with some fields drawn anew, which gets past the
doors and deep into a node. Both give only what a peer could send: what a type refuses is never given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np
from hypothesis import strategies as st
from msgspec import inspect

from msgs.bus.codec import CodecError, decode, encode
from msgs.bus.interface import Envelope, Received
from msgs.bus.topics import TOPICS
from msgs.values.arrays import DTYPES

NAN, INF = float("nan"), float("inf")
#: What msgpack carries at most, and what int64 does.
EDGES = (-(2**63), -(2**62), -(2**31), -1, 0, 1, 2**31, 2**53, 2**62 - 1, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
INTS = st.one_of(st.integers(-3, 40), st.sampled_from(EDGES), st.integers(-(2**63), 2**64 - 1))
FLOAT_EDGES = (0.0, -0.0, 5e-324, 1e-300, 1e-9, 1.0, 1e9, 1e19, 1e39, 1e155, 1e300, 1.7e308, INF, -INF, NAN)
FLOATS = st.one_of(st.floats(-100.0, 100.0), st.sampled_from(FLOAT_EDGES), st.floats())
WORDS = (
    "",
    "coherent",
    "magnitude",
    "welch",
    "photons",
    "lost_chirps",
    "array_error",
    "ready",
    "\x00",
    "\u2028",
    "é" * 9,
)
TEXTS = st.one_of(st.sampled_from(WORDS), st.text(max_size=20))
#: By how much stamps and numbers are moved from where they were.
SHIFTS = (-(2**62), -(10**18), -(10**11), -(10**9), -(3 * 10**8), -2, -1, 1, 2, 3 * 10**8, 10**9, 10**11, 10**18, 2**62)


def drawn(kind: inspect.Type) -> st.SearchStrategy[Any]:
    """Any value of a type, legal or not: the types themselves refuse what is not."""
    match kind:
        case inspect.IntType():
            return INTS
        case inspect.FloatType():
            return FLOATS
        case inspect.StrType():
            return TEXTS
        case inspect.BoolType():
            return st.booleans()
        case inspect.NoneType():
            return st.none()
        case inspect.EnumType():
            return st.sampled_from(list(kind.cls))
        case inspect.LiteralType():
            return st.sampled_from(kind.values)
        case inspect.UnionType():
            return st.one_of([drawn(one) for one in kind.types])
        case inspect.VarTupleType():
            return st.lists(drawn(kind.item_type), max_size=4).map(tuple)
        case inspect.TupleType():
            return st.tuples(*[drawn(one) for one in kind.item_types])
        case inspect.DictType():
            return st.dictionaries(TEXTS, st.one_of(TEXTS, INTS), max_size=2)
        case inspect.StructType():
            return structs(kind)
        case inspect.CustomType():
            return arrays()
    return st.none()


@st.composite
def structs(draw: st.DrawFn, kind: inspect.StructType) -> Any:
    """A struct with all its fields drawn, by its defaults where it refuses one of them; None where it has none."""
    good: dict[str, Any] = {}
    for field in kind.fields:
        value = draw(drawn(field.type))
        if field.required or accepted(kind.cls, good | {field.name: value}):
            good[field.name] = value
    return kind.cls(**good) if accepted(kind.cls, good) else None


def accepted(kind: type, fields: Mapping[str, Any]) -> bool:
    """Whether a struct takes these fields."""
    try:
        kind(**fields)
    except (ValueError, TypeError, ArithmeticError):
        return False
    return True


@st.composite
def arrays(draw: st.DrawFn) -> np.ndarray:
    """A small array of any type that may travel."""
    shape = draw(st.lists(st.integers(0, 4), max_size=3))
    dtype = np.dtype(draw(st.sampled_from(sorted(DTYPES))))
    return draw(refilled(np.zeros(shape, dtype)))


@st.composite
def refilled(draw: st.DrawFn, array: np.ndarray) -> np.ndarray:
    """An array of the same layout: all, most or one of its cells at an edge of its type, or random bits."""
    out = array.copy()
    seed, share = draw(st.integers(0, 99)), draw(st.sampled_from((1.0, 0.5, 0.01, 0.0)))
    rng = np.random.default_rng(seed)
    hit = rng.random(out.shape) < share
    if share == 0.0 and out.size:
        hit.flat[rng.integers(out.size)] = True
    if draw(st.booleans()):
        bits = np.frombuffer(rng.bytes(out.nbytes), np.uint8)
        noise = (bits & 1).view("|b1") if out.dtype.kind == "b" else bits.view(out.dtype)
        out[hit] = noise.reshape(out.shape)[hit]
    else:
        out[hit] = _edge(out.dtype, draw(st.integers(0, 30)))
    return out


def _edge(dtype: np.dtype, number: int) -> Any:
    """An extreme value of a type."""
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        return (limits.min, limits.max, 0, 1)[number % 4]
    if dtype.kind == "b":
        return bool(number % 2)
    value = FLOAT_EDGES[number % len(FLOAT_EDGES)]
    most = float(np.finfo(dtype).max)
    return np.clip(value, -most, most) if np.isfinite(value) else value


@st.composite
def near(draw: st.DrawFn, value: Any) -> Any:
    """A struct like `value`, up to four of its fields drawn anew; those that it refuses stay as they are."""
    fields = inspect.type_info(type(value)).fields  # type: ignore[attr-defined]
    if not fields:
        return value
    for field in draw(st.lists(st.sampled_from(fields), max_size=4)):
        anew = draw(_near_field(getattr(value, field.name), field.type))
        try:
            value = msgspec.structs.replace(value, **{field.name: anew})
        except (ValueError, TypeError, ArithmeticError):
            continue
    return value


def _near_field(value: Any, kind: inspect.Type) -> st.SearchStrategy[Any]:
    """Any value of a field's type, mostly one that has to do with the value it has."""
    if isinstance(value, msgspec.Struct):
        return near(value)
    if isinstance(value, np.ndarray):
        return refilled(value)
    if isinstance(value, bool):
        return st.booleans()
    if isinstance(value, int):
        return st.one_of(drawn(kind), st.sampled_from(SHIFTS).map(lambda by: value + by))
    if isinstance(value, float):
        factors = st.sampled_from((-1.0, 1e-3, 1.001, 2.0, 1e3, 1e9))
        return st.one_of(drawn(kind), factors.map(lambda factor: value * factor))
    if isinstance(value, tuple) and value and isinstance(value[0], msgspec.Struct):
        return st.lists(st.sampled_from(value).flatmap(near), max_size=2 * len(value) + 1).map(tuple)
    return drawn(kind)


class Said(NamedTuple):
    """A message and its topic."""

    topic: str
    message: msgspec.Struct


class Step(NamedTuple):
    """One call of a node."""

    inputs: list[Received]
    now_ns: int


def carried(said: Said, envelope: Envelope) -> Received | None:
    """A message as it comes out of the bus, read-only arrays and all; None where the codec lets it not through."""
    try:
        return decode([bytes(frame) for frame in encode(envelope, said.message)])
    except CodecError:
        return None


@st.composite
def scripts(draw: st.DrawFn, natural: Sequence[Said], topics: Sequence[str], most_runs: int = 3) -> list[Step]:
    """Steps of what peers might say: runs of the natural order, cut, repeated, reordered, touched, by several peers.

    A tenth of the messages have nothing to do with the good ones; `now_ns` goes on, jumps, and goes back.
    """
    steps: list[Step] = []
    now_ns = draw(st.sampled_from((0, 10**9, 10**15, 2**61)))
    numbers: dict[str, int] = {}
    for _ in range(draw(st.integers(0, most_runs))):
        publisher = draw(st.sampled_from(("radar", "other")))
        is_touched, size = draw(st.integers(0, 3)) > 0, draw(st.sampled_from((1, 1, 2, 7)))
        inputs: list[Received] = []
        for said in draw(_runs(natural)):
            one = draw(_touched(said, topics)) if is_touched and draw(st.integers(0, 2)) == 0 else said
            gap = draw(st.sampled_from((1, 1, 1, 2, 9, -5))) if is_touched else 1
            numbers[publisher] = min(max(numbers.get(publisher, -1) + gap, 0), 2**48)
            envelope = Envelope(
                publisher=publisher,
                topic=one.topic,
                sequence=numbers[publisher],
                sent_ns=max(now_ns, 0),
                paced=is_touched and draw(st.booleans()),
            )
            received = carried(one, envelope)
            inputs += [] if received is None else [received]
            if len(inputs) >= size:
                steps.append(Step(inputs, now_ns))
                inputs = []
                now_ns += draw(st.sampled_from((0, 1, 10**6, 10**7, 6 * 10**8, 10**11, -(10**9))))
        steps.append(Step(inputs, now_ns))
    return steps


@st.composite
def _runs(draw: st.DrawFn, natural: Sequence[Said]) -> list[Said]:
    """A stretch of the natural order, whole, or some of it in any order."""
    if not natural:
        return []
    if draw(st.integers(0, 2)):
        start = draw(st.integers(0, len(natural) - 1))
        return list(natural[start : start + draw(st.integers(1, len(natural)))])
    return draw(st.lists(st.sampled_from(natural), max_size=8))


@st.composite
def _touched(draw: st.DrawFn, said: Said, topics: Sequence[str]) -> Said:
    """A message like `said`, or any other of the node's topics."""
    if draw(st.integers(0, 9)):
        return Said(said.topic, draw(near(said.message)))
    topic = draw(st.sampled_from(sorted(topics)))
    message = draw(drawn(inspect.type_info(TOPICS[topic].type)))
    return said if message is None else Said(topic, message)


def wrong_params(good: Mapping[str, Any], params_type: type[msgspec.Struct]) -> st.SearchStrategy[dict[str, Any]]:
    """Parameters as a launch file may hold them: good ones with some fields drawn anew, of the right type or not."""
    fields = inspect.type_info(params_type).fields  # type: ignore[attr-defined]
    junk: st.SearchStrategy[Any] = st.one_of(
        st.none(),
        INTS,
        FLOATS,
        TEXTS,
        st.booleans(),
        st.lists(INTS, max_size=2),
        st.dictionaries(TEXTS, INTS, max_size=1),
    )
    if not fields:
        return st.dictionaries(TEXTS, junk, max_size=2)
    selected = st.lists(st.sampled_from(fields), max_size=3, unique_by=lambda field: field.name)
    return selected.flatmap(lambda some: _with_fields(good, some, junk))


def _with_fields(
    good: Mapping[str, Any], fields: Sequence[Any], junk: st.SearchStrategy[Any]
) -> st.SearchStrategy[dict[str, Any]]:
    anew = {field.name: st.one_of(_near_default(field), _plain(field.type, junk), junk) for field in fields}
    return st.fixed_dictionaries(anew).map(lambda drawn_fields: {**good, **drawn_fields})


def _near_default(field: Any) -> st.SearchStrategy[Any]:
    """A number like the one a field has by default, any value of its type where it has none."""
    is_number = isinstance(field.default, int | float) and not isinstance(field.default, bool)
    return _near_field(field.default, field.type) if is_number else drawn(field.type)


def _plain(kind: inspect.Type, junk: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """A value of a parameter as plain data: structs as maps of some of their fields."""
    if isinstance(kind, inspect.StructType):
        some = st.lists(st.sampled_from(kind.fields), max_size=2, unique_by=lambda field: field.name)
        return some.flatmap(lambda fields: _with_fields({}, fields, junk)) if kind.fields else st.just({})
    if isinstance(kind, inspect.UnionType):
        return st.one_of([_plain(one, junk) for one in kind.types])
    return drawn(kind)
