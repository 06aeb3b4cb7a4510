"""Lua scripts of mmWave Studio, the maker's capture tool, as the configuration of a DCA1000 capture.

Read is a small part of Lua, one statement a line: comments, `NAME = value` and calls such as `ar1.ProfileConfig(...)`,
where a value is a number, a text, a name given before, or sums and products of these. Anything else (conditions, loops,
functions) is refused with its line: what is not read may change what the capture holds. The statements share their
syntax with Python, whose parser reads them; nothing is run.
"""

from __future__ import annotations

import ast
import math
import re
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from contrib.boards.dca1000_capture import DEVICES, ChirpCfg, Dca1000Config, DeviceName, ProfileCfg, configured

#: A text, kept, or a comment, which goes.
#: One without end reaches as far as it could: it is looked for once.
_TEXT_OR_COMMENT = re.compile(
    r"""("(?:\\.|[^"\\\n])*+"?|'(?:\\.|[^'\\\n])*+'?)|--\[\[.*?(?:\]\]|\Z)|--[^\n]*""", re.DOTALL
)
#: Calls that leave layout and timing of the samples alone.
_WITHOUT_EFFECT = frozenset(
    {
        "ar1.FullReset", "ar1.SOPControl", "ar1.Connect", "ar1.Disconnect", "ar1.Calling_IsConnected", "ar1.PowerOn",
        "ar1.PowerOff", "ar1.frequencyBandSelection", "ar1.deviceVariantSelection", "ar1.DownloadBSSFw",
        "ar1.DownloadMSSFw", "ar1.GetBSSFwVersion", "ar1.GetMSSFwVersion", "ar1.GetBSSPatchFwVersion", "ar1.RfEnable",
        "ar1.RfInit", "ar1.LPModConfig", "ar1.LvdsClkConfig", "ar1.SetCalMonFreqLimitConfig", "ar1.DisableTestSource",
        "ar1.CaptureCardConfig_EthInit", "ar1.CaptureCardConfig_PacketDelay", "ar1.CaptureCardConfig_StartRecord",
        "ar1.CaptureCardConfig_StopRecord", "ar1.PacketHandlerZeroFill", "ar1.StartFrame", "ar1.StopFrame",
        "ar1.StartMatlabPostProc", "ar1.SaveSettings", "RSTD.Sleep", "WriteToLog", "print",
    }
)  # fmt: skip
_OPERATORS: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
}
#: Characters of a statement: as deep as that, sums and brackets are read without end of stack.
_LONGEST = 600
_RULE = f"must be NAME = VALUE or NAME(VALUES) of at most {_LONGEST} characters"
Value = float | str
#: Floats under this hold every whole number.
_WHOLE = 1 << 53


class Call(NamedTuple):
    """A call of a script."""

    line: int
    name: str
    arguments: tuple[Value, ...]


def parse_lua(text: str, name: str, device: DeviceName | None = None) -> Dca1000Config:
    """Return the configuration of a script; the device from `ar1.SelectChipVersion` unless given.

    Raises `ValueError` that begins with `name` and the line for statements, calls and values that are not read, and as
    `parse_cfg` does for settings that do not fit each other.
    """
    fields: dict[str, Any] = {}
    for call in _calls(text, name):
        _take(fields, call, f"{name}: line {call.line}: {call.name}")
    device_name = fields.get("device", device)
    lanes = DEVICES[device_name].lanes if device_name else 2
    if fields.pop("q_first", False):
        fields["adcbufCfg"] = {"sample_swap": 1, "channel_interleave": 0 if lanes == 4 else 1}
    if (taken := fields.pop("taken_lanes", lanes)) != lanes:
        raise ValueError(f"{name}: ar1.CaptureCardConfig_Mode must take {lanes} lanes of {device_name}, got {taken}")
    return configured(fields, name, device)


def _calls(text: str, name: str) -> Iterator[Call]:
    values: dict[str, Value] = {}
    for line, statement in _statements(text):
        where = f"{name}: line {line}"
        for node in _parsed(statement, where):
            if isinstance(node, ast.Assign) and len(node.targets) == 1 and isinstance(node.targets[0], ast.Name):
                values[node.targets[0].id] = _value(node.value, values, where)
            elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call) and not node.value.keywords:
                call = node.value
                arguments = tuple(_value(argument, values, where) for argument in call.args)
                yield Call(line, ast.unparse(call.func), arguments)
            else:
                raise ValueError(f"{where}: {_RULE}, got {statement[:80]!r}")


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """Yield each statement with its first line, comments taken off; a call may reach over lines."""
    bare = _TEXT_OR_COMMENT.sub(lambda match: match[1] or "\n" * match[0].count("\n"), text)
    begun, first = "", 0
    for number, line in enumerate(bare.split("\n"), start=1):
        if not begun:
            first = number
        begun = f"{begun} {line.strip()}".strip()
        without_texts = _TEXT_OR_COMMENT.sub("", begun)
        if begun and (without_texts.count("(") <= without_texts.count(")") or len(begun) > _LONGEST):
            yield first, begun.removeprefix("local ").lstrip()
            begun = ""
    if begun:
        yield first, begun


def _parsed(statement: str, where: str) -> list[ast.stmt]:
    # a comment of Python is an operator of Lua
    if len(statement) <= _LONGEST and "#" not in _TEXT_OR_COMMENT.sub("", statement):
        try:
            with warnings.catch_warnings():
                # paths of Windows hold backslashes
                warnings.simplefilter("ignore")
                return ast.parse(statement).body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            pass
    raise ValueError(f"{where}: {_RULE}, got {statement[:80]!r}")


def _value(node: ast.expr, values: dict[str, Value], where: str) -> Value:
    match node:
        case ast.Constant(value=str() as text):
            return text
        case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
            return _number(number, where)
        case ast.Name(id=key) if key in values:
            return values[key]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return -_operand(operand, values, where)
        case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
            a, b = _operand(left, values, where), _operand(right, values, where)
            try:
                return _number(_OPERATORS[type(operator)](a, b), where)
            except ZeroDivisionError:
                raise ValueError(f"{where}: must not divide by zero, got {ast.unparse(node)!r}") from None
    raise ValueError(f"{where}: must be a number, a text or a name given before, got {ast.unparse(node)[:80]!r}")


def _operand(node: ast.expr, values: dict[str, Value], where: str) -> float:
    value = _value(node, values, where)
    if isinstance(value, str):
        raise ValueError(f"{where}: must reckon with numbers, got {value!r}")
    return value


def _number(number: float, where: str) -> float:
    """Return a finite number, a whole one as int: counts are whole."""
    try:
        value = float(number)
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise ValueError(f"{where}: must have finite numbers, got {value!r}")
    return int(value) if abs(value) < _WHOLE and value.is_integer() else value


def _take(fields: dict[str, Any], call: Call, where: str) -> None:
    """Put what a call says under the names of TI's commands."""
    if call.name in _WITHOUT_EFFECT:
        return
    if call.name in _FIXED:
        for at, (expected, rule) in _FIXED[call.name].items():
            actual = call.arguments[at] if at < len(call.arguments) else None
            if actual != expected:
                raise ValueError(f"{where}: value {at + 1} must be {expected!r} ({rule}), got {actual!r}")
    elif call.name not in _READERS:
        raise ValueError(f"{where} must be a call that is known")
    if call.name not in _READERS:
        return
    counts, reader = _READERS[call.name]
    if len(call.arguments) not in counts:
        raise ValueError(f"{where} must have {' or '.join(map(str, counts))} values, got {len(call.arguments)}")
    for command, content in reader(call.arguments, where).items():
        if command == "chirpCfg":
            fields.setdefault(command, []).append(content)
        elif command in fields:
            raise ValueError(f"{where} must stand once, got it again")
        else:
            fields[command] = content


def _mask(switches: tuple[Value, ...], where: str) -> int:
    """Return a bit for each switch that is on."""
    if not set(switches) <= {0, 1}:
        raise ValueError(f"{where}: switches must be 0 or 1, got {', '.join(map(repr, switches))}")
    return sum(1 << at for at, switch in enumerate(switches) if switch)


def _device(values: tuple[Value, ...], where: str) -> dict[str, Any]:
    series = re.search(r"(\d\d)\d\d", str(values[0]))
    device = f"xwr{series[1]}xx" if series else ""
    if device not in DEVICES:
        raise ValueError(f"{where} must name a device of {', '.join(DEVICES)}, got {values[0]!r}")
    return {"device": device}


def _channels(values: tuple[Value, ...], where: str) -> dict[str, Any]:
    q_first = _mask(values[9:], where)
    return {
        "channelCfg": {"tx_mask": _mask(values[:3], where), "rx_mask": _mask(values[3:7], where)},
        "adcCfg": {"adc_bits": values[7], "output_format": values[8]},
        **({"q_first": True} if q_first else {}),
    }


def _sent_lanes(values: tuple[Value, ...], where: str) -> dict[str, Any]:
    return {"sent_lanes": _mask(values[1:5], where).bit_count()}


def _taken_lanes(values: tuple[Value, ...], where: str) -> dict[str, Any]:
    if values[1] not in _TAKEN_LANES:
        raise ValueError(f"{where}: value 2 must be 1 (four lanes) or 2 (two), got {values[1]!r}")
    return {"taken_lanes": _TAKEN_LANES[values[1]]}


def _profile(values: tuple[Value, ...], where: str) -> dict[str, Any]:
    times, backoffs, phases, rest = values[:5], values[5:8], values[8:11], values[11:]
    for what, each in (("backoff", backoffs), ("phase", phases)):
        # a transmitter that is weaker or turned against the others would bend the row
        if len(set(each)) > 1:
            raise ValueError(f"{where}: {what} must be that of all transmitters, got {', '.join(map(repr, each))}")
    words = (*times, backoffs[0], phases[0], *rest)
    return {"profileCfg": dict(zip(ProfileCfg.__struct_fields__, words, strict=True))}


def _chirp(values: tuple[Value, ...], where: str) -> dict[str, Any]:
    words = (*values[:7], _mask(values[7:], where))
    return {"chirpCfg": dict(zip(ChirpCfg.__struct_fields__, words, strict=True))}


def _frame(values: tuple[Value, ...], where: str) -> dict[str, Any]:
    names = ("chirp_start_index", "chirp_end_index", "frames", "loops", "period_ms")
    return {"frameCfg": dict(zip(names, values[:5], strict=True))}


_TAKEN_LANES: dict[Value, int] = {1: 4, 2: 2}
#: Values of calls that must be one, by their places: value, rule.
_FIXED: dict[str, dict[int, tuple[Value, str]]] = {
    "ar1.DataPathConfig": {0: (1, "LVDS"), 1: (1, "ADC samples alone"), 2: (0, "nothing beside them")},
    "ar1.LVDSLaneConfig": {0: (0, "the first format"), 5: (1, "highest bit first"), 7: (0, "no checksums")},
    "ar1.SelectCaptureDevice": {0: ("DCA1000", "the card")},
    "ar1.CaptureCardConfig_Mode": {0: (1, "raw"), 2: (1, "capture"), 3: (2, "Ethernet"), 4: (3, "16 bits")},
}
#: Counts of values that a call may have, and its reader.
_READERS: dict[str, tuple[tuple[int, ...], Callable[[tuple[Value, ...], str], dict[str, Any]]]] = {
    "ar1.SelectChipVersion": ((1,), _device),
    "ar1.ChanNAdcConfig": ((10,), _channels),
    "ar1.LVDSLaneConfig": ((8,), _sent_lanes),
    "ar1.CaptureCardConfig_Mode": ((6,), _taken_lanes),
    "ar1.ProfileConfig": ((18,), _profile),
    "ar1.ChirpConfig": ((10,), _chirp),
    # delay and kind of the trigger follow, which no sample depends on
    "ar1.FrameConfig": ((7, 8), _frame),
}
