"""Verbs and options of earlier versions: another spelling took their place, or a constant did."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice

#: Verb -> its name today.
_VERBS = {"bag trim": "bag filter"}
#: Verb -> option -> option of today.
_RENAMED = {
    "eval": {"--places": "--count"},
    "tradeoff": {"--frames": "--count"},
    "compare": {"--jobs": "--workers"},
    "can monitor": {"--bitrate": "--option=bitrate"},
}
#: Verb -> option -> the constant in its place.
_CONSTANTS = {
    "eval": {
        "--truth": "thinned",
        "--threshold": "of the network's card, or threshold=T of the --method",
        "--reference": "the last --method",
        "--draws": "1000",
        "--sweep": "the threshold of each method",
        "--false-cost": "that of the sets, else 1",
    },
    "tradeoff": {"--repeats": "2"},
    "export": {
        "--split": "the test scenes",
        "--test": "the test scenes of the run's data",
        "--range-bins": "as trained",
    },
    "node kill": {"--signal": "KILL"},
    "bag snapshot": {"--timeout": "60 s"},
    "calibrate background": {"--scans": "100"},
    "calibrate noise": {"--scans": "20"},
    "calibrate array": {"--scans": "100"},
    "graph": {"--svg": "no drawing; dot -Tsvg draws what --dot writes"},
    "sim statistics": {"--out": "no page; --json prints all numbers"},
    "sim lidar": {"--guess-m": "0.3 m", "--guess-deg": "3 deg"},
    "import xradarnlos": {"--keys": "L,G,T"},
    "import dca1000": {"--returns": "5"},
    "import transients": {"--snr": "1"},
    "train residual": {"--source": "peaks", "--frame": "wall", "--geometry": "that of the specification"},
    "train objects": {"--field-epochs": "as many as --epochs"},
    "train probabilities": {"--false-cost": "1"},
    "train dense": {"--objective": "that of the network", "--without": "all scenes"},
}


def present_words(words: list[str], say: Callable[[str], object]) -> list[str]:
    """Return a command line in the words of today; `say` gets a line for each option that became a constant."""
    for length in (2, 1):
        verb = " ".join(words[:length])
        if verb in _VERBS:
            return [*_VERBS[verb].split(), *words[length:]]
        if verb in _RENAMED or verb in _CONSTANTS:
            return [*words[:length], *_present_options(verb, iter(words[length:]), say)]
    return words


def _present_options(verb: str, words: Iterator[str], say: Callable[[str], object]) -> Iterator[str]:
    renamed, constants = _RENAMED.get(verb, {}), _CONSTANTS.get(verb, {})
    for word in words:
        option, given, value = word.partition("=")
        if option in renamed:
            today, _, key = renamed[option].partition("=")
            yield today
            for follower in [value] if given else islice(words, 1):
                yield f"{key}={follower}" if key else follower
        elif option in constants:
            if not given:
                next(words, "")
            say(f"{option} of `{verb}` is a constant: {constants[option]}")
        else:
            yield word
