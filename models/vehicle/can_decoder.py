"""Vehicle state from CAN frames: valid frames, their values in SI units, and their time of validity; no clock."""

from __future__ import annotations

from collections import Counter, deque
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from models.vehicle.can_frame import FrameCheck, Verdict
from models.vehicle.can_mapping import CanMapping, MessageRule, QuantityRule, WheelSpeedsRule, period_ns
from models.vehicle.end_to_end import signal_of
from models.vehicle.quantity import Quantity
from models.vehicle.signal_units import Dimension
from msgs.values.arrays import MAX_STAMP_NS
from msgs.values.units import NANOSECONDS_PER_SECOND, s_from_ns
from msgs.values.vehicle import VehicleState
from msgs.values.wording import counted

if TYPE_CHECKING:
    from cantools.database import Database
    from cantools.database.can import Message

#: What a message said holds while it is younger than this many of its periods.
AGE_PERIODS = 10
#: An invalid state is said again at least this often.
INVALID_INTERVAL_NS = 100_000_000
#: Stamps that go back further than this are a new start, not a late frame.
RESTART_NS = 1_000_000_000
#: Frames of one bus are delayed by no more than this more than others, but for those that waited to be read.
_DELAYS_DIFFER_NS = 100_000_000
#: A state must fit its topic's byte limit whatever a DBC calls its signals.
_REASON_LIMIT = 500
#: So many frames without one that is looked for are no chance.
_MANY_FRAMES = 100


#: What each quantity of a mapping measures.
DIMENSIONS = {"speed": Dimension.SPEED, "yaw rate": Dimension.ANGULAR_RATE, "steering": Dimension.ANGLE}

#: Frames that are no fault of the car: every bus carries messages that no mapping asks for.
HARMLESS = frozenset({Verdict.COUNTED, Verdict.FIRST, Verdict.UNKNOWN_ID, Verdict.REMOTE_FRAME})


class Judged(NamedTuple):
    """Verdict on a frame, the message it belongs to, and the reason where it does not count."""

    verdict: Verdict
    message: str = ""
    why: str = ""


class CanDecoder:
    """Decoder of the frames of one car, its last values; `ValueError` where mapping and DBC do not meet."""

    def __init__(self, database: Database, mapping: CanMapping) -> None:
        self._by_name = {message.name: message for message in database.messages}
        self._watches: dict[str, _Watch] = {}
        self._rules = mapping.messages
        self._quantities = {
            name: self._quantity(name, name.replace(" ", "_"), rule, DIMENSIONS[name])
            for name, rule in mapping.quantities.items()
        }
        self._wheels = [] if mapping.wheel_speeds is None else self._wheel_sides(mapping.wheel_speeds)
        self._sources = [*self._quantities.values(), *self._wheels]
        #: How ranges and units of the DBC were read where that is not plain; for the log.
        self.warnings = tuple(dict.fromkeys(text for item in self._sources for text in item.quantity.warnings))
        for name in mapping.messages:
            if name not in self._watches:
                raise ValueError(f"messages.{name}: no quantity is taken from this message")
        self._by_id = {watch.frame_id: watch for watch in self._watches.values()}
        self._newest_ns = 0
        #: How many frames met each verdict.
        self.counts: Counter[Verdict] = Counter()

    @property
    def speed_message(self) -> str:
        """Name of the message that sets the rate of the states."""
        return self._quantities["speed"].watch.name

    def add(self, arbitration_id: int, data: bytes, stamp_ns: int, extended: bool = False) -> Judged:
        """Take in one data frame; never raises for what a bus can carry."""
        judged = self._judge(arbitration_id, data, stamp_ns, extended)
        self.counts[judged.verdict] += 1
        return judged

    def skip(self, verdict: Verdict) -> Judged:
        """Count a frame that carries no data."""
        self.counts[verdict] += 1
        return Judged(verdict)

    def state(self, now_ns: int) -> VehicleState:
        """Return the state at `now_ns`; not valid, with reasons, while a quantity is missing, old or out of range."""
        troubles = [text for text in (item.trouble(now_ns) for item in self._quantities.values()) if text]
        unknown_frames = self.counts[Verdict.UNKNOWN_ID]
        if unknown_frames >= _MANY_FRAMES and not any(watch.seen for watch in self._watches.values()):
            troubles.append(f"{counted(unknown_frames, 'frame')} of other ids came: wrong DBC?")
        stamps_ns = [item.stamp_ns for item in self._quantities.values() if item.stamp_ns is not None]
        steering = self._quantities.get("steering")
        return VehicleState(
            stamp_ns=now_ns,
            speed_mps=self._quantities["speed"].value,
            yaw_rate_rps=self._quantities["yaw rate"].value,
            steering_rad=steering.value if steering else 0.0,
            wheel_speed_difference_mps=self._wheel_difference_mps(now_ns),
            valid=not troubles,
            reason="; ".join(troubles)[:_REASON_LIMIT],
            age_s=s_from_ns(max(0, now_ns - min(stamps_ns, default=now_ns))),
        )

    def expiry_ns(self) -> int | None:
        """Return when the state stops being valid if nothing more comes; None while something has never come."""
        times_ns = [item.expiry_ns() for item in self._quantities.values()]
        known_ns = [time_ns for time_ns in times_ns if time_ns is not None]
        return min(known_ns) if len(known_ns) == len(times_ns) else None

    def _wheel_difference_mps(self, now_ns: int) -> float | None:
        """Return the speed of the right wheels less that of the left ones; the state is valid without it."""
        if not self._wheels or any(side.trouble(now_ns) for side in self._wheels):
            return None
        left, right = self._wheels
        return right.value - left.value

    def _judge(self, arbitration_id: int, data: bytes, stamp_ns: int, extended: bool) -> Judged:
        if not 0 <= stamp_ns < MAX_STAMP_NS:
            return Judged(Verdict.BAD_STAMP, why=f"stamp {stamp_ns} ns")
        if stamp_ns < self._newest_ns - RESTART_NS:
            self._forget()
        self._newest_ns = max(self._newest_ns, stamp_ns)
        watch = self._by_id.get((arbitration_id, extended))
        if watch is None:
            return Judged(Verdict.UNKNOWN_ID)
        verdict, why = watch.judge(data, stamp_ns)
        if verdict is Verdict.COUNTED:
            faults = [item.take(stamp_ns) for item in self._sources if item.watch is watch]
            if why := "; ".join(fault for fault in faults if fault):
                verdict = Verdict.OUT_OF_RANGE
        return Judged(verdict, watch.name, why)

    def _forget(self) -> None:
        self._newest_ns = 0
        for item in self._sources:
            item.stamp_ns = None
        for watch in self._watches.values():
            watch.forget()

    def _quantity(self, name: str, field: str, rule: QuantityRule, dimension: Dimension) -> _Quantity:
        watch = self._watch(rule.message, f"{field}.message")
        quantity = Quantity(field, rule, watch.message, dimension)
        if rule.negative_while is None:
            return _Quantity(name, quantity, watch, None)
        where = f"{field}.negative_while"
        sign_watch = self._watch(rule.negative_while.message, f"{where}.message")
        signal_of(sign_watch.message, rule.negative_while.signal, f"{where}.signal")
        return _Quantity(name, quantity, watch, sign_watch)

    def _wheel_sides(self, rule: WheelSpeedsRule) -> list[_Quantity]:
        """Return the speed of the left side, then that of the right one."""
        sides = {"left": rule.side(rule.left), "right": rule.side(rule.right)}
        return [self._quantity(f"{name} wheels", "wheel_speeds", side, Dimension.SPEED) for name, side in sides.items()]

    def _watch(self, name: str, field: str) -> _Watch:
        if name not in self._by_name:
            raise ValueError(f"{field}: the DBC has no message {name!r}")
        if name not in self._watches:
            self._watches[name] = _Watch(self._by_name[name], self._rules.get(name, MessageRule()))
        return self._watches[name]


class _Watch:
    """Watch over one message: the check of its frames, and the time of the last one that counted."""

    def __init__(self, message: Message, rule: MessageRule) -> None:
        self.message = message
        self.name = message.name
        self.frame_id = (message.frame_id, message.is_extended_frame)
        self._limit_ns = AGE_PERIODS * period_ns(message, rule)
        self._frames = FrameCheck(message, rule)
        self.forget()

    def forget(self) -> None:
        """Forget all frames."""
        self.values: dict[str, float] = {}
        self.stamp_ns: int | None = None
        self.seen = False
        self._last_ns: int | None = None
        self._frames.forget()
        self._refused = ""

    def judge(self, data: bytes, stamp_ns: int) -> tuple[Verdict, str]:
        """Take in a frame and judge it: the verdict, and the reason where it does not count."""
        verdict, why = self._check(data, stamp_ns)
        self.seen = True
        self._refused = why
        if verdict is Verdict.COUNTED:
            self.stamp_ns = stamp_ns
        return verdict, why

    def expiry_of(self, stamp_ns: int | None) -> int | None:
        """Return when the content of a frame of this stamp is too old."""
        return None if stamp_ns is None else stamp_ns + self._limit_ns

    def silence(self, stamp_ns: int | None, now_ns: int) -> str:
        """Return why there is no frame younger than ten periods; empty if there is one."""
        if stamp_ns is not None and now_ns - stamp_ns < self._limit_ns:
            return ""
        good = "good " if self._refused else ""
        since = "yet" if stamp_ns is None else f"for {s_from_ns(now_ns - stamp_ns):.2f} s"
        return f"no {good}{self.name} {since}" + (f" ({self._refused})" if self._refused else "")

    def _check(self, data: bytes, stamp_ns: int) -> tuple[Verdict, str]:
        if self._last_ns is not None and stamp_ns < self._last_ns and not self._frames.length_fault(data):
            return Verdict.LATE, f"late: {s_from_ns(self._last_ns - stamp_ns):.3f} s older than the one before"
        silent = self._last_ns is None or stamp_ns - self._last_ns >= self._limit_ns
        verdict, why, values = self._frames.check(data, silent)
        if values is not None:
            self._last_ns = stamp_ns
            if verdict is Verdict.COUNTED:
                self.values = values
        return verdict, why


class _Quantity:
    """Last value of speed, yaw rate or steering that was within its range."""

    def __init__(self, name: str, quantity: Quantity, watch: _Watch, sign_watch: _Watch | None) -> None:
        self._name, self.quantity, self.watch, self._sign_watch = name, quantity, watch, sign_watch
        self.value = 0.0
        self.stamp_ns: int | None = None
        self._fault = ""

    def take(self, stamp_ns: int) -> str:
        """Take the value from the frame that has just counted; return its fault, empty if there is none."""
        self._fault = self._read(stamp_ns)
        return self._fault

    def trouble(self, now_ns: int) -> str:
        """Return why the value cannot be used at `now_ns`; empty if it can."""
        # the message may go on without this signal (multiplexed), so its own stamp counts too
        why = self.watch.silence(self.watch.stamp_ns, now_ns) or self._fault
        why = why or self.watch.silence(self.stamp_ns, now_ns)
        if not why and self._sign_watch is not None:
            why = self._sign_watch.silence(self._sign_watch.stamp_ns, now_ns)
        return f"{self._name}: {why}" if why else ""

    def expiry_ns(self) -> int | None:
        """Return when the value is too old."""
        times_ns = [self.watch.expiry_of(self.stamp_ns)]
        if self._sign_watch is not None:
            times_ns.append(self._sign_watch.expiry_of(self._sign_watch.stamp_ns))
        known_ns = [time_ns for time_ns in times_ns if time_ns is not None]
        return min(known_ns) if len(known_ns) == len(times_ns) else None

    def _read(self, stamp_ns: int) -> str:
        values, rule = [], self.quantity.rule
        for index, signal in enumerate(self.quantity.signals):
            # a multiplexed signal is not in every frame
            if (value := self.watch.values.get(signal.name)) is None:
                return self._fault
            if fault := self.quantity.range_fault(index, value):
                return fault
            values.append(float(value))
        value = self.quantity.to_si(values, self._is_negative())
        if not rule.low <= value <= rule.high:
            names = ", ".join(rule.signals)
            return f"{names} gives {value:g}, outside the mapping's {rule.low:g}..{rule.high:g}"
        self.value, self.stamp_ns = value, stamp_ns
        return ""

    def _is_negative(self) -> bool:
        rule = self.quantity.rule.negative_while
        return (
            rule is not None
            and self._sign_watch is not None
            and rule.is_negative(self._sign_watch.values.get(rule.signal))
        )


class StateReporter:
    """Reporter of the state at the rate of the speed message; one that is not valid also without a message."""

    def __init__(self, decoder: CanDecoder, start_ns: int) -> None:
        self.decoder = decoder
        self._due_ns = start_ns
        self._said_ns = start_ns - INVALID_INTERVAL_NS
        self._was_valid = False

    def frame(self, judged: Judged, stamp_ns: int) -> VehicleState | None:
        """Return the state if the frame just judged was a speed message that counts."""
        is_speed = judged.message == self.decoder.speed_message
        if not is_speed or judged.verdict not in (Verdict.COUNTED, Verdict.OUT_OF_RANGE):
            return None
        return self._say(self.decoder.state(stamp_ns))

    def tick(self, now_ns: int, trouble: str = "") -> VehicleState | None:
        """Return the state if it is due; `trouble` of the bus itself makes it invalid."""
        if now_ns < self.due_ns(trouble):
            return None
        state = self.decoder.state(now_ns)
        if trouble:
            state = msgspec.structs.replace(state, valid=False, reason=trouble[:_REASON_LIMIT])
        if state.valid and self._was_valid:
            # younger frames of the other messages have come meanwhile
            self._arm(state)
            return None
        return self._say(state)

    def due_ns(self, trouble: str = "") -> int:
        """Return when `tick` has something to publish: when the state expires, then at every period."""
        return min(self._due_ns, self._said_ns + INVALID_INTERVAL_NS) if trouble else self._due_ns

    def _say(self, state: VehicleState) -> VehicleState:
        self._said_ns, self._was_valid = state.stamp_ns, state.valid
        self._arm(state)
        return state

    def _arm(self, state: VehicleState) -> None:
        expiry_ns = self.decoder.expiry_ns() if state.valid else None
        self._due_ns = state.stamp_ns + INVALID_INTERVAL_NS if expiry_ns is None else expiry_ns


class StampMapper:
    """Map of stamps of another clock onto the bus clock by the least delay of one to two windows.

    Clocks that drift or are set are followed within two seconds; one stamp alone that is far off is taken to be new.
    """

    def __init__(self) -> None:
        self._was_off = False
        self._least_ns: deque[int] = deque(maxlen=2)
        self._window_end_ns: int | None = None

    def map(self, stamp_ns: int, arrival_ns: int) -> int:
        """Return the stamp on the clock of `arrival_ns`, never later than that."""
        difference_ns = arrival_ns - stamp_ns
        self._was_off = not self._was_off and self._is_off(difference_ns)
        if self._was_off:
            return arrival_ns
        if self._window_end_ns is None or arrival_ns >= self._window_end_ns:
            self._window_end_ns = arrival_ns + NANOSECONDS_PER_SECOND
            self._least_ns.append(difference_ns)
        self._least_ns[-1] = min(self._least_ns[-1], difference_ns)
        return stamp_ns + min(self._least_ns)

    def _is_off(self, difference_ns: int) -> bool:
        """Return whether a stamp is further ahead than delays differ, or older than any queue makes it."""
        if not self._least_ns:
            return False
        return not -_DELAYS_DIFFER_NS <= difference_ns - min(self._least_ns) <= RESTART_NS
