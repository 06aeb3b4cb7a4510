"""Header of an ASC log as python-can reads it, whatever language and clock the tool that wrote it was set to.

python-can ends the header at the first line that it does not know, and refuses the log for a date that it cannot read:
a month of another language hides the base of the numbers, and "15:06:13 pm" all frames.
"""

from __future__ import annotations

import logging
import re
import unicodedata
from collections.abc import Iterable, Iterator
from datetime import datetime

_LOG = logging.getLogger(__name__)

_FRAME = re.compile(r"\s*\d+\.\d+\s")
_BASE = re.compile(r"\s*base\s+(hex|dec)", re.IGNORECASE)
_DATE = re.compile(r"\s*(date|begin\s+triggerblock)\s+(.+)", re.IGNORECASE)
_CLOCK = re.compile(r"\b(\d{1,2}):(\d\d)(?::(\d\d)(?:[.,:](\d{1,9}))?)?(?:\s*([ap])\.?\s?m\b)?", re.IGNORECASE)
#: Beginnings of the months' names, without accents: English, German, French, Spanish, Italian, Dutch, Portuguese,
#: Swedish, Polish, Czech.
_MONTHS = (
    "jan gen ene sty led", "feb fev lut uno", "mar mrz maer mrt bre", "apr avr abr kwi dub", "may mai mag mei maj kve",
    "jun juin giu cze cerven cvn", "jul juil lug lip cervenec cvc", "aug aou ago sie srp", "sep set wrz zar",
    "oct okt ott out paz rij", "nov lis", "dec dez dic gru pro",
)  # fmt: skip
_MONTH_OF = {name: number for number, names in enumerate(_MONTHS, 1) for name in names.split()}
_ENGLISH = [names.split()[0].capitalize() for names in _MONTHS]
_YEAR = re.compile(r"(?<!\d)(?:19|20)\d\d(?!\d)")
#: Year, month and day as numbers, and day, month and year with dots; with slashes they are told apart by nobody.
_NUMBERS = re.compile(r"(?P<y>\d{4})-(?P<m>\d\d?)-(?P<d>\d\d?)|(?P<D>\d\d?)\.\s?(?P<M>\d\d?)\.\s?(?P<Y>\d{4})")


def plain_asc(lines: Iterable[str]) -> Iterator[str]:
    """Yield lines of an ASC log: the header of those lines alone that python-can knows, and every date in English.

    A date that cannot be read is left out with a warning; stamps then count from zero.
    """
    header: list[str] | None = []
    for line in lines:
        dated = _DATE.match(line)
        is_body = _FRAME.match(line) or (dated and dated[1].lower() != "date")
        if header is not None and is_body:
            yield from header
            yield "no internal events logged\n"
            header = None
        if dated:
            date = plain_date(dated[2])
            if date is None:
                _LOG.warning("stamps count from zero: no date can be read from %r", line.strip()[:80])
            elif header is None:
                yield f"{dated[1]} {date}\n"
            else:
                header.append(f"date {date}\n")
        elif header is None:
            yield line
        elif _BASE.match(line):
            header.append(line.lstrip())


def plain_date(text: str) -> str | None:
    """Return a date as python-can reads it ("Sat Sep 30 15:06:13.191000 2017"), None where day or time is missing."""
    clock = _CLOCK.search(text)
    if clock is None:
        return None
    hour, minute, second = (int(part or 0) for part in clock.group(1, 2, 3))
    half = (clock[5] or "").lower()
    # some tools count to 24 and write "pm" beside it
    hour = hour % 12 + (12 if half == "p" else 0) if half and hour <= 12 else hour
    day = _day(text[: clock.start()] + " " + text[clock.end() :])
    try:
        stamp = None if day is None else datetime(*day, hour, minute, second)
    except ValueError:
        return None
    if stamp is None:
        return None
    micros = (clock[4] or "0").ljust(6, "0")[:6]
    return f"Sun {_ENGLISH[stamp.month - 1]} {stamp:%d %H:%M:%S}.{micros} {stamp:%Y}"


def _day(text: str) -> tuple[int, int, int] | None:
    """Return year, month and day of a date; the month is the last word that may be one, as weekdays come before."""
    if numbers := _NUMBERS.search(text):
        year, month, day = (numbers[name] or numbers[name.upper()] for name in "ymd")
        return int(year), int(month), int(day)
    plain = unicodedata.normalize("NFKD", text.lower()).encode("ascii", "ignore").decode()
    words = re.findall("[a-z]+", plain)
    # "mar" is a Tuesday of three languages before it is a month
    months = [month for word in words[len(words) > 1 :] if (month := _month(word))]
    years = _YEAR.findall(plain)
    days = re.findall(r"(?<!\d)\d{1,2}(?!\d)", plain)
    return (int(years[-1]), months[-1], int(days[0])) if years and months and days else None


def _month(word: str) -> int | None:
    """Return the month whose name begins as a word does, the longest beginning first."""
    return next((_MONTH_OF[word[:size]] for size in range(len(word), 2, -1) if word[:size] in _MONTH_OF), None)
