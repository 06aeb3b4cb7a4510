"""Mutation testing: plausible bugs put into a copy of the sources, one at a time, and the tests that notice.

`benchmarks/mutation/mutations.yaml` lists the mutations: text of a file that stands there exactly once, what takes its
place, and the tests that should notice. A mutant meets those tests, then the test files that name its module, then all
that mirror its room. It is killed by the first test that fails on it and passes on the unchanged copy. Those of whole
graphs (`tests/graph`) are left out unless they are named. Verdicts are kept in a log, from which the next run goes on.
Exit code 1 where a mutant survives.
Usage: python -m benchmarks.mutation.mutations [--group reviewed] [--only NAME ...] [--limit 900] [--fresh] [--json]
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import msgspec
import yaml

from msgs.files.shipped import CHECKOUT

ROOT = CHECKOUT
LIST = Path(__file__).with_name("mutations.yaml")
#: What a copy of the tree does without, at its top.
LEFT_OUT = (".git", ".venv", ".pytest_cache", ".mypy_cache", ".ruff_cache", ".hypothesis", "runs", "out", "data")


class Mutation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A plausible bug: text that stands exactly once in a file, and what takes its place."""

    name: str
    file: str
    old: str
    new: str
    reason: str
    #: `guard`: a hard case without what keeps it stable; `reviewed`: put in by hand; `drawn`: at random.
    group: Literal["guard", "reviewed", "drawn"]
    #: Test files or single tests that should notice, run first.
    tests: tuple[str, ...] = ()


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """What became of a mutant, and the test that killed it."""

    name: str
    group: str
    status: Literal["killed", "survived", "timed out"]
    killed_by: str = ""


def load_list(path: Path = LIST) -> list[Mutation]:
    """The mutations of a list; raises `ValueError` for names that repeat."""
    mutations = msgspec.convert(yaml.load(path.read_text(), Loader=yaml.CSafeLoader), list[Mutation])
    name, count = Counter(mutation.name for mutation in mutations).most_common(1)[0]
    if count > 1:
        raise ValueError(f"{path}: names must differ, {name!r} repeats")
    return mutations


def mutated(source: str, mutation: Mutation) -> str:
    """The text of a mutant's file; raises `ValueError` where the old text does not stand exactly once."""
    if (count := source.count(mutation.old)) != 1:
        raise ValueError(f"{mutation.file}: text of {mutation.name!r} must stand once, stands {count} times")
    return source.replace(mutation.old, mutation.new)


@functools.cache
def _test_texts(root: Path) -> dict[str, str]:
    """Test files of a tree by their path in it, in order."""
    return {str(test.relative_to(root)): test.read_text() for test in sorted((root / "tests").rglob("test_*.py"))}


def stages_of(root: Path, mutation: Mutation) -> Iterator[list[str]]:
    """Tests of a mutant in the order in which they run, none twice; those of one list run together."""
    path, texts = Path(mutation.file), _test_texts(root)
    word = re.compile(rf"\b{path.stem}\b")
    # a test that walks through the whole tree of sources or starts whole programs says nothing of one module
    readers = [file for file in texts if not file.startswith(("tests/docs/", "tests/fuzz/", "tests/graph/"))]
    naming = [file for file in readers if path.stem in file or word.search(texts[file])]
    room = "/".join(("tests", *path.parts[: 2 if path.parts[0] == "models" else 1], ""))
    taken = set[str]()
    for stage in (list(mutation.tests), naming, [file for file in texts if file.startswith(room)]):
        if fresh := [test for test in stage if test not in taken]:
            yield fresh
        taken |= set(stage)


def judge(copy: Path, mutation: Mutation, limit_s: float) -> Verdict:
    """Let a mutant meet its tests in a copy of the tree, which is afterwards as before."""
    path, until_s, unfit = copy / mutation.file, time.monotonic() + limit_s, list[str]()
    original, killed_by = path.read_text(), ""
    with TemporaryDirectory() as cache:
        # kernels that were compiled of others inline what they call: none may outlast a change of it
        compiled = {"NUMBA_CACHE_DIR": cache} if "numba" in original else {}
        try:
            for stage in stages_of(copy, mutation):
                while not killed_by:
                    path.write_text(mutated(original, mutation))
                    failed = first_failure(copy, stage, unfit, until_s, compiled)
                    path.write_text(original)
                    if not failed or failed in unfit:
                        break
                    if first_failure(copy, [failed], [], until_s, {}):
                        unfit.append(failed)
                    else:
                        killed_by = failed
        except subprocess.TimeoutExpired:
            return Verdict(name=mutation.name, group=mutation.group, status="timed out")
        finally:
            path.write_text(original)
    status: Literal["killed", "survived"] = "killed" if killed_by else "survived"
    return Verdict(name=mutation.name, group=mutation.group, status=status, killed_by=killed_by)


def first_failure(copy: Path, tests: list[str], skipped: list[str], until_s: float, more: dict[str, str]) -> str:
    """Name of the first test that fails; empty: none. A file that cannot be read as tests counts as one."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=no", "-p", "no:cacheprovider"]
    command += [*(f"--deselect={name}" for name in skipped), *tests]
    environment = os.environ | {"PYTHONPATH": str(copy), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"} | more
    # a mutant as long as the original and of the same second would be run from the original's bytecode
    environment |= {"MIRRORWAVE_RUN_DIR": str(copy.parent / "run"), "PYTHONDONTWRITEBYTECODE": "1"}
    left_s = max(until_s - time.monotonic(), 0.0)
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, timeout=left_s)
    if done.returncode == 4:
        raise ValueError(f"tests must exist: {' '.join(done.stderr.split())}")
    # a mutant may end the whole process
    return "" if done.returncode in (0, 5) else first_failed(done.stdout) or tests[0]


def first_failed(summary: str) -> str:
    """Return the first test that pytest's summary names as failed; its parameters may hold spaces. Empty: none."""
    found = re.search(r"^(?:FAILED|ERROR) ([^\s\[]+\[.*?\](?= - |$)|\S+)", summary, re.MULTILINE)
    return found[1] if found else ""


def run(mutations: Sequence[Mutation], log: Path, root: Path = ROOT, limit_s: float = 900.0) -> list[Verdict]:
    """Verdicts of mutations in their order; those that a log has come from it, the others are added.

    Raises `ValueError` before any test is run where a mutation does not fit its file.
    """
    for mutation in mutations:
        mutated((root / mutation.file).read_text(), mutation)
    log.parent.mkdir(parents=True, exist_ok=True)
    lines = log.read_bytes().splitlines() if log.exists() else []
    known = {verdict.name: verdict for verdict in (msgspec.json.decode(line, type=Verdict) for line in lines)}
    with TemporaryDirectory(prefix="mutants-") as folder, log.open("ab") as stream:
        copy = Path(folder) / "tree"
        shutil.copytree(root, copy, ignore=lambda path, _: LEFT_OUT if Path(path) == root else ())
        for mutation in (mutation for mutation in mutations if mutation.name not in known):
            verdict = known[mutation.name] = judge(copy, mutation, limit_s)
            stream.write(msgspec.json.encode(verdict) + b"\n")
            stream.flush()
            print(f"{verdict.status:9s}  {verdict.name}  {verdict.killed_by}", file=sys.stderr, flush=True)
    return [known[mutation.name] for mutation in mutations]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[], metavar="TEXT", help="those whose names contain a text")
    parser.add_argument("--group", choices=("guard", "reviewed", "drawn"))
    parser.add_argument("--limit", type=float, default=900.0, help="seconds a mutant")
    parser.add_argument("--log", type=Path, default=ROOT / "runs" / "mutations.jsonl", help="verdicts, to go on from")
    parser.add_argument("--fresh", action="store_true", help="judge all again")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.fresh:
        arguments.log.unlink(missing_ok=True)
    wanted = [
        one
        for one in load_list()
        if arguments.group in (None, one.group)
        and (not arguments.only or any(text in one.name for text in arguments.only))
    ]
    verdicts = run(wanted, arguments.log, limit_s=arguments.limit)
    counts = Counter(f"{verdict.group} {verdict.status}" for verdict in verdicts)
    if arguments.json:
        print(json.dumps({"counts": counts, "mutations": msgspec.to_builtins(verdicts)}, indent=1))
    else:
        print("\n".join(f"{what}: {count}" for what, count in sorted(counts.items())))
    return int(any(verdict.status != "killed" for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
