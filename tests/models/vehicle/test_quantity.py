"""Units and ranges of a DBC: what is taken as it stands, what is recognised, what is refused."""

from __future__ import annotations

import math

import cantools
import msgspec
import pytest

from models.vehicle.can_mapping import DbcRange, QuantityRule
from models.vehicle.quantity import Quantity
from models.vehicle.signal_units import Dimension, parse_unit


def quantity(
    dbc_unit: str = "m/s", scaling: str = "(0.01,0)", limits: str = "[0|0]", bits: str = "0|16@1+",
    dimension: Dimension = Dimension.SPEED, **rule: object,
) -> Quantity:  # fmt: skip
    """The quantity of one signal V of a DBC that is written for the case."""
    dbc = f'VERSION ""\nBO_ 16 A: 8 X\n SG_ V : {bits} {scaling} {limits} "{dbc_unit}" X\n'
    message = cantools.database.load_string(dbc, "dbc", strict=False).messages[0]
    values = {"message": "A", "signals": ("V",), "low": -1e4, "high": 1e4, **rule}
    return Quantity("speed", msgspec.convert(values, QuantityRule), message, dimension)


@pytest.mark.parametrize(
    ("text", "to_si", "dimension"),
    [
        ("km/h", 1 / 3.6, Dimension.SPEED), ("KPH", 1 / 3.6, Dimension.SPEED), ("Km / h", 1 / 3.6, Dimension.SPEED),
        ("m/s", 1.0, Dimension.SPEED), ("mps", 1.0, Dimension.SPEED), ("mph", 0.44704, Dimension.SPEED),
        ("deg", math.pi / 180, Dimension.ANGLE), ("\u00b0", math.pi / 180, Dimension.ANGLE),
        ("rad", 1.0, Dimension.ANGLE), ("deg/s", math.pi / 180, Dimension.ANGULAR_RATE),
        ("\u00c2\u00b0/s", math.pi / 180, Dimension.ANGULAR_RATE), ("rad/s", 1.0, Dimension.ANGULAR_RATE),
        ("Deg/Sec", math.pi / 180, Dimension.ANGULAR_RATE), ("g", 9.80665, Dimension.ACCELERATION),
        ("m/s^2", 1.0, Dimension.ACCELERATION), ("m/s/s", 1.0, Dimension.ACCELERATION),
        ("m/s\u00b2", 1.0, Dimension.ACCELERATION),
    ],
)  # fmt: skip
def test_spellings_of_units(text: str, to_si: float, dimension: Dimension) -> None:
    unit = parse_unit(text)
    assert unit is not None
    assert (unit.to_si, unit.dimension) == (pytest.approx(to_si), dimension)


@pytest.mark.parametrize("text", ["", None, "rpm", "kmm/h", "%", "rads"])
def test_what_is_no_unit_of_ours(text: str | None) -> None:
    assert parse_unit(text) is None


def test_km_h_is_never_taken_for_m_s() -> None:
    """36 km/h is 10 m/s by the DBC's own unit, by the mapping's, and by a scale that is a calibration of it."""
    assert quantity("km/h").to_si([36.0], negative=False) == pytest.approx(10.0)
    assert quantity("", unit="kph").to_si([36.0], negative=False) == pytest.approx(10.0)
    assert quantity("km/h", scale=1.02 / 3.6).to_si([36.0], negative=False) == pytest.approx(10.2)
    with pytest.raises(ValueError, match=r"^speed\.scale: must be within 10 % of 0\.277777778, .* got 1\.0; leave"):
        quantity("km/h", scale=1.0)


def test_a_dbc_whose_unit_is_wrong_is_overruled_with_a_warning() -> None:
    overruled = quantity("km/h", unit="m/s")
    assert overruled.to_si([36.0], negative=False) == 36.0
    assert overruled.warnings == ["speed.unit: m/s is taken for V, the DBC says km/h"]
    assert quantity("kph", unit="km/h").warnings == []


@pytest.mark.parametrize(
    ("unit", "rule", "complaint"),
    [
        ("", {}, r"speed\.unit: must be given, the DBC states no unit for V; known are m/s, km/h, mph, knot, ft/s"),
        ("rpm", {}, r"speed\.unit: must be given, the DBC states the unit 'rpm' for V"),
        ("g", {}, r"speed\.unit: must be of m/s, .*; V is in g, which is no speed"),
        ("g", {"scale": 9.8}, r"V is in g, which is no speed"),
        ("", {"unit": "deg/s"}, r"speed\.unit: must be of m/s, .*; is given in deg/s, which is no speed"),
    ],
)
def test_a_unit_that_nobody_states_is_refused(unit: str, rule: dict, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        quantity(unit, **rule)


def test_a_scale_states_what_the_dbc_does_not() -> None:
    assert quantity("", scale=0.5).to_si([36.0], negative=False) == 18.0


def test_signals_of_two_units_are_refused() -> None:
    dbc = """VERSION ""
BO_ 16 A: 8 X
 SG_ V : 0|16@1+ (0.01,0) [0|0] "deg" X
 SG_ F : 16|16@1+ (0.01,0) [0|0] "rad" X
"""
    message = cantools.database.load_string(dbc, "dbc").messages[0]
    rule = QuantityRule(message="A", signals=("V", "F"), low=-1.0, high=1.0)
    with pytest.raises(ValueError, match=r"steering\.signals: must be of one unit, the DBC has 'deg' and 'rad'"):
        Quantity("steering", rule, message, Dimension.ANGLE)


def test_a_unit_of_a_mapping_must_be_known() -> None:
    with pytest.raises(ValueError, match=r"unit must be one of m/s, km/h, .*deg/s.* got 'furlong'"):
        QuantityRule(message="A", signals=("V",), unit="furlong", low=0.0, high=1.0)


@pytest.mark.parametrize(
    ("bits", "scaling", "limits", "low", "high"),
    [
        # 10 bits, offset: raw 0..1023 is -125..124.612; 65535 reaches beyond, 0 would cut the turns to one side
        ("0|10@1+", "(0.244,-125)", "[0|65535]", -125.0, 124.612),
        ("0|10@1+", "(0.244,-125)", "[0|1023]", -125.0, 124.612),
        # some counts at the top mean "not available": the limits are counts all the same
        ("0|12@1+", "(0.01,-20.48)", "[0|4000]", -20.48, 19.52),
        # exactly the counts of the bits, though the scaled values reach further
        ("0|8@1+", "(2,-100)", "[0|255]", -100.0, 410.0),
        ("0|8@1-", "(2,10)", "[-128|127]", -246.0, 264.0),
        # a falling scale turns the ends round
        ("0|10@1+", "(-0.244,125)", "[0|65535]", -124.612, 125.0),
    ],
)
def test_ranges_in_raw_counts_are_recognised(bits: str, scaling: str, limits: str, low: float, high: float) -> None:
    found = quantity(scaling=scaling, limits=limits, bits=bits)
    (warning,) = found.warnings
    assert "is taken as raw counts" in warning
    assert "speed.dbc_range: physical overrules this" in warning
    step = abs(float(scaling[1:].split(",")[0]))
    for value in (low, high):
        assert not found.range_fault(0, value)
    # beyond the limits by more than the half step that rounding may take
    assert found.range_fault(0, high + 0.6 * step)
    assert found.range_fault(0, low - 0.6 * step)


@pytest.mark.parametrize(
    ("bits", "scaling", "limits", "inside", "outside"),
    [
        # an offset and a range that the bits can well have: wheel speeds of public DBC files
        ("0|16@1+", "(0.01,-67.67)", "[0|250]", 249.0, -5.0),
        ("0|12@1-", "(1.5,0)", "[-500|500]", -499.5, 502.5),
        # a generous limit beyond the bits on one side is no count: it would leave 0..4
        ("0|16@1-", "(0.01,0)", "[0|400]", 320.0, -1.0),
        # wider than the bits on both sides: refuses nothing, as it stands
        ("0|16@1-", "(0.01,0)", "[-400|400]", -327.0, 401.0),
        # half a step beyond what the bits hold is how limits are rounded
        ("0|9@1-", "(0.005,0)", "[-1.2775|1.2775]", 1.275, 1.29),
        # neither scale nor offset: counts and values are the same
        ("0|8@1+", "(1,0)", "[0|100]", 99.0, 120.0),
    ],
)
def test_physical_ranges_stay(bits: str, scaling: str, limits: str, inside: float, outside: float) -> None:
    found = quantity(scaling=scaling, limits=limits, bits=bits)
    assert found.warnings == []
    assert not found.range_fault(0, inside)
    assert found.range_fault(0, outside)


def test_a_float_has_no_counts() -> None:
    """As an integer of 32 bits these limits would be its counts."""
    case = {"bits": "0|32@1+", "scaling": "(0.5,-10)", "limits": "[0|4294967295]"}
    dbc = 'VERSION ""\nBO_ 16 A: 8 X\n SG_ V : 0|32@1- (0.5,-10) [0|4294967295] "m/s" X\nSIG_VALTYPE_ 16 V : 1;\n'
    message = cantools.database.load_string(dbc, "dbc").messages[0]
    rule = QuantityRule(message="A", signals=("V",), low=-1.0, high=1.0)
    assert quantity(**case).warnings
    assert not Quantity("speed", rule, message, Dimension.SPEED).warnings


def test_the_mapping_overrules_what_is_recognised() -> None:
    case = {"bits": "0|10@1+", "scaling": "(0.244,-125)", "limits": "[0|65535]"}
    assert quantity(**case, dbc_range="physical").range_fault(0, -10.0)
    assert not quantity(**case, dbc_range="physical").warnings
    for choice in (DbcRange.AUTO, DbcRange.RAW, DbcRange.IGNORE):
        assert not quantity(**case, dbc_range=choice).range_fault(0, -10.0)
    # a range in counts that no rule can know: 3 bits of 16 are used
    assert not quantity(scaling="(0.5,-2)", limits="[0|7]", dbc_range="raw").range_fault(0, -2.0)
    assert quantity(scaling="(0.5,-2)", limits="[0|7]", dbc_range="raw").range_fault(0, 2.0)
    assert quantity(scaling="(0.5,-2)", limits="[3|7]", dbc_range="raw").range_fault(0, -2.0)
    assert not quantity(limits="[0|5]", dbc_range="ignore").range_fault(0, 600.0)
    for choice in DbcRange:
        assert quantity(dbc_range=choice).range_fault(0, math.nan)


def test_a_range_that_is_no_range_of_counts_is_refused_as_one() -> None:
    with pytest.raises(ValueError, match=r"speed\.dbc_range: must not be raw, 300\.\.400 of the DBC are no counts of"):
        quantity(bits="0|8@1+", scaling="(0.5,0)", limits="[300|400]", dbc_range="raw")
    with pytest.raises(ValueError, match="must not be raw"):
        quantity(bits="0|8@1+", scaling="(0.5,0)", limits="[-9|-1]", dbc_range="raw")


@pytest.mark.parametrize(
    ("value", "parts"),
    [(3.47, [3.5, 0.0, -0.03]), (3.54, [3.5, 0.0, 0.04]), (-1.234, [-1.0, -0.2, -0.034]), (1000.0, [1000.0, 0.0, 0.0])],
)
def test_a_sum_is_shared_out_by_the_steps_of_each_signal(value: float, parts: list[float]) -> None:
    """Steps of 0.5, 0.1 and 0.001: each takes the nearest that it can, the last the remainder as its bits permit."""
    dbc = """VERSION ""
BO_ 16 A: 8 X
 SG_ V : 0|16@1- (0.5,0) [0|0] "m/s" X
 SG_ W : 16|16@1- (0.1,0) [0|0] "m/s" X
 SG_ X : 32|16@1- (0.001,0) [0|0] "m/s" X
"""
    rule = QuantityRule(message="A", signals=("V", "W", "X"), combine="sum", low=-2e3, high=2e3)
    few_bits = dbc.replace("16@1- (0.001,0)", "8@1- (0.0001,0)")
    for text, last in ((dbc, parts[-1]), (few_bits, min(max(parts[-1], -0.0128), 0.0127))):
        message = cantools.database.load_string(text, "dbc").messages[0]
        quantities, negative = Quantity("speed", rule, message, Dimension.SPEED).from_si(value)
        assert (quantities, negative) == (pytest.approx([*parts[:-1], last]), False)
