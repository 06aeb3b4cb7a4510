"""Every reader of bytes from outside, on the inputs that fuzzing kept and on seeded changes of valid ones.

The short form of `python -m fuzz` (docs/results/README.md), without its feedback: each input gives a value or
a documented refusal, and leaves its file as it was.
"""

from __future__ import annotations

import logging
import random
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from fuzz.mutations import CHANGES, joined, mutated, split
from fuzz.seeds import SEEDS
from fuzz.targets import TARGETS, Box, Target, execute
from msgs.files.shipped import CHECKOUT

CORPUS = CHECKOUT / "fuzz" / "corpus"
#: Changes a target, so that each takes about a tenth of a second: readers of small messages see hundreds.
CHANGES_A_TARGET = 40
FAST = dict.fromkeys(
    ("inline", "foreign", "viewer_client", "log_lines", "background", "card", "cloud", "dca1000", "keys", "words"), 250
)
SLOW = {
    "convert": 6,
    "sigmf": 4,
    "dbc": 4,
    "can_log": 6,
    "plan": 4,
    "can_frames": 10,
    "launch": 12,
    "map": 60,
    "scene": 12,
    "settings": 20,
    "mapping": 20,
    "view": 25,
    "shard": 30,
}
#: All valid inputs of these are refused: one that is accepted would be larger than a corpus should hold.
NEVER_WHOLE = {"xradarnlos"}


@pytest.fixture(autouse=True)
def _quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_valid_inputs_are_read_and_changed_ones_read_or_refused(name: str, tmp_path: Path) -> None:
    target = TARGETS[name]
    seeds = SEEDS[name]()
    read = [execute(target, parts, tmp_path / "box") for parts in seeds[:4]]
    assert any(read) or name in NEVER_WHOLE
    rng = random.Random(zlib.crc32(name.encode()))
    for _ in range((FAST | SLOW).get(name, CHANGES_A_TARGET)):
        execute(target, mutated(rng.choice(seeds), target.kinds, rng), tmp_path / "box")


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(CORPUS.rglob("*.bin")), ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_what_was_found_stays_mended(path: Path, tmp_path: Path) -> None:
    execute(TARGETS[path.parent.name], split(path.read_bytes()), tmp_path / "box")


def test_every_corpus_belongs_to_a_target_and_is_small() -> None:
    files = [path for path in CORPUS.rglob("*") if path.is_file()]
    assert {path.parent.name for path in files} <= set(TARGETS)
    assert {path.suffix for path in files} <= {".bin"}
    assert sum(path.stat().st_size for path in files) < 200_000


def test_a_reader_that_fails_otherwise_is_caught(tmp_path: Path) -> None:
    def wrong(parts: list[bytes], box: Box) -> None:
        raise KeyError(parts[0])

    def greedy(parts: list[bytes], box: Box) -> None:
        box.put("a", parts[0]).write_bytes(b"other")

    with pytest.raises(KeyError):
        execute(Target(wrong, ("bytes",)), [b"x"], tmp_path)
    with pytest.raises(AssertionError, match="was changed by its reader"):
        execute(Target(greedy, ("bytes",)), [b"x"], tmp_path)


def test_parts_survive_as_one_string_and_any_string_has_parts() -> None:
    assert split(joined([b"", b"ab", b"\xff" * 300])) == [b"", b"ab", b"\xff" * 300]
    rng = random.Random(3)
    for _ in range(200):
        assert all(isinstance(part, bytes) for part in split(rng.randbytes(rng.randrange(40))))


@pytest.mark.parametrize("kind", CHANGES)
def test_a_change_changes_and_is_the_same_for_the_same_seed(kind: str) -> None:
    parts = next(parts for name, target in TARGETS.items() if kind in target.kinds for parts in SEEDS[name]())
    changed = [mutated(parts, (kind,), random.Random(seed)) for seed in range(20)]
    assert [mutated(parts, (kind,), random.Random(seed)) for seed in range(20)] == changed
    assert sum(one != parts for one in changed) >= 15
