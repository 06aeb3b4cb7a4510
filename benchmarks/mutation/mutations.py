"""Mutation testing: plausible bugs put into a copy of the sources, one at a time, and the tests that notice.

`benchmarks/mutation/mutations.yaml` lists the mutations: text of a file that stands there exactly once, what takes its
place, and the tests that should notice. A mutant goes through stages: those tests, the test file of its module, those
that import the module, the rest of the tests that mirror its room, `tests/stability`; all mutants through one stage
before any goes on to the next. It is killed by the first test that fails on it twice and passes on the unchanged copy.
Tests that start processes of the graph are left out. The tree itself is never written to. What an earlier run has done
is taken from the log, stage by stage, unless the mutation, its file or the tests that ran have changed since. Exit code
1 where a mutant survives. Usage: python -m benchmarks.mutation.mutations [--group reviewed] [--only NAME ...] [--jobs
2] [--limit 900] [--json]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import msgspec
import yaml
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from msgs.files.shipped import CHECKOUT

ROOT = CHECKOUT
LIST = Path(__file__).with_name("mutations.yaml")
#: What a copy of the tree does without, at its top.
LEFT_OUT = (".git", ".venv", ".pytest_cache", ".mypy_cache", ".ruff_cache", ".hypothesis", "runs", "out", "data")
LAST_STAGE = "tests/stability"


Status = Literal["unknown", "killed", "survived", "timed out"]


class Mutation(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A plausible bug: text that stands exactly once in a file, and what takes its place."""

    name: str
    file: str
    old: str
    new: str
    reason: str
    #: `guard`: a hard case without what keeps it stable; `reviewed`: put in by hand; `drawn`: `mutation_draw`.
    group: Literal["guard", "reviewed", "drawn"]
    #: Test files or single tests that should notice, run first.
    tests: tuple[str, ...] = ()
    #: Why nothing observable changes; such a mutation is listed and not run.
    equivalent: str = ""


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """What became of a mutant: its status (`unknown`: tests are left), the test that killed it, the tests that ran."""

    name: str
    group: str
    status: Status
    killed_by: str
    seconds: float
    ran: tuple[str, ...]
    #: Tests that fail without the mutation too, or only sometimes with it: they say nothing.
    unfit: tuple[str, ...] = ()
    #: Of the mutation, the text of its file and of the tests that ran.
    digest: str


class _OutOfTimeError(Exception):
    """A mutant's time is over."""


def load_list(path: Path = LIST) -> list[Mutation]:
    """The mutations of a list; raises `ValueError` for names that repeat."""
    mutations = msgspec.convert(yaml.load(path.read_text(), Loader=yaml.CSafeLoader), list[Mutation])
    names = [mutation.name for mutation in mutations]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{path}: names must differ, {repeated[0]!r} repeats")
    return mutations


def mutated(source: str, mutation: Mutation) -> str:
    """The text of a mutant's file; raises `ValueError` where the old text does not stand exactly once."""
    if (count := source.count(mutation.old)) != 1:
        raise ValueError(f"{mutation.file}: text of {mutation.name!r} must stand once, stands {count} times")
    return source.replace(mutation.old, mutation.new)


def stages_of(root: Path, mutation: Mutation) -> Iterator[list[str]]:
    """Tests of a mutant in the order in which they run, none twice; those of one list run together."""
    taken = set[str]()
    for stage in _overlapping_stages(root, mutation):
        fresh = [test for test in dict.fromkeys(stage) if test not in taken]
        taken |= set(fresh)
        if fresh:
            yield fresh


def _overlapping_stages(root: Path, mutation: Mutation) -> Iterator[list[str]]:
    """All stages, each looked for once the one before it has run."""
    yield list(mutation.tests)
    path = Path(mutation.file)
    files = sorted(str(test.relative_to(root)) for test in (root / "tests").rglob("test_*.py"))
    yield [file for file in files if Path(file).stem.startswith(f"test_{path.stem}")]
    # a test that walks through the whole tree of sources or starts whole programs says nothing of one module
    readers = [file for file in files if not file.startswith(("tests/docs/", "tests/fuzz/"))]
    module = mutation.file.removesuffix(".py").replace("/", ".")
    yield [file for file in readers if _imports((root / file).read_text(), module)]
    yield [file for file in files if file.startswith(f"{mirrored_room(path)}/")]
    yield [LAST_STAGE] if (root / LAST_STAGE).exists() else []


def _imports(text: str, module: str) -> bool:
    """Return whether a test imports a module or names it."""
    package, _, stem = module.rpartition(".")
    pattern = rf"\b{re.escape(module)}\b|from {re.escape(package)} import [^\n]*\b{stem}\b"
    # most texts do not hold the word, which is seen much sooner
    return stem in text and re.search(pattern, text) is not None


def mirrored_room(path: Path) -> str:
    """Folder of the tests that mirror a source's room: of models the inner one's, else the root's."""
    return "/".join(("tests", *path.parts[: 2 if path.parts[0] == "models" else 1]))


class Workspace:
    """A copy of the tree in which one mutant at a time lives."""

    def __init__(self, root: Path, folder: Path, stop: threading.Event) -> None:
        self.folder, self._original, self._stop = folder / "tree", folder / "original", stop
        shutil.copytree(root, self.folder, ignore=lambda path, _: LEFT_OUT if Path(path) == root else ())

    def judge(self, mutation: Mutation, before: Verdict | None, limit_s: float) -> Verdict:
        """Run the next stage of a mutant's tests; raises `ValueError` where the mutation does not fit its file."""
        start_s, killed_by, is_over = time.monotonic(), "", False
        unfit = list(before.unfit) if before else []
        ran, spent_s = (before.ran, before.seconds) if before else ((), 0.0)
        stages = [
            left for stage in stages_of(self.folder, mutation) if (left := [test for test in stage if test not in ran])
        ]
        if stages:
            try:
                killed_by = self._killer(mutation, stages[0], start_s + limit_s - spent_s, unfit)
                ran = (*ran, *stages[0])
            except _OutOfTimeError:
                is_over = True
        return Verdict(
            name=mutation.name,
            group=mutation.group,
            status="timed out" if is_over else "killed" if killed_by else "unknown" if stages[1:] else "survived",
            killed_by=killed_by,
            seconds=round(spent_s + time.monotonic() - start_s, 1),
            ran=ran,
            unfit=tuple(unfit),
            digest=digest_of(self.folder, mutation, ran),
        )

    def _killer(self, mutation: Mutation, tests: list[str], until_s: float, unfit: list[str]) -> str:
        """The first test that fails on the mutant, twice, and passes on the unchanged copy; empty: none.

        Others that fail are added to `unfit`. Raises `ValueError` for a file that cannot be read as tests at all.
        """
        path = self.folder / mutation.file
        mutant = mutated(path.read_text(), mutation)
        # with its time of change, by which compiled code is known to be its
        shutil.copy2(path, self._original)
        with TemporaryDirectory(dir=self.folder.parent) as cache:
            # kernels that were compiled of others inline what they call: none may outlast a change of it
            numba_cache = Path(cache) if "numba" in mutant else None
            try:
                while True:
                    path.write_text(mutant)
                    failed = self._first_failure(tests, unfit, until_s, numba_cache)
                    if not failed or failed in unfit:
                        return ""
                    fails_again = bool(self._first_failure([failed], [], until_s, numba_cache))
                    shutil.copy2(self._original, path)
                    fails_unchanged = bool(self._first_failure([failed], [], until_s, None))
                    if fails_again and not fails_unchanged:
                        return failed
                    if fails_unchanged and "::" not in failed:
                        raise ValueError(f"{failed}: must be read as tests in an unchanged copy of the tree")
                    unfit.append(failed)
            finally:
                shutil.copy2(self._original, path)

    def _first_failure(self, tests: list[str], without: list[str], until_s: float, numba_cache: Path | None) -> str:
        """Name of the first test that fails; empty: none. A file that cannot be read as tests counts as one."""
        command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=no", "-p", "no:cacheprovider", "-m", "not graph"]
        command += [*(f"--deselect={name}" for name in without), *tests]
        environment = os.environ | {"PYTHONPATH": str(self.folder), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        # a mutant as long as the original and of the same second would be run from the original's bytecode
        environment |= {"MIRRORWAVE_RUN_DIR": str(self.folder.parent / "run"), "PYTHONDONTWRITEBYTECODE": "1"}
        environment |= {} if numba_cache is None else {"NUMBA_CACHE_DIR": str(numba_cache)}
        code, output = self._run(command, environment, until_s)
        if code in (-signal.SIGTERM, -signal.SIGINT, -signal.SIGHUP):
            # that is no verdict: a mutant has no reason to ask itself to end
            raise InterruptedError(f"tests were ended from outside by {signal.Signals(-code).name}")
        if code == 4:
            raise ValueError(f"tests must exist: {' '.join(output.split())}")
        if code in (0, 5):
            return ""
        # a mutant may end the whole process
        return first_failed(output) or tests[0]

    def _run(self, command: list[str], environment: dict[str, str], until_s: float) -> tuple[int, str]:
        with (self.folder.parent / "pytest.log").open("w+") as log:
            process = subprocess.Popen(
                command,
                cwd=self.folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                while process.poll() is None:
                    if time.monotonic() > until_s or self._stop.is_set():
                        raise _OutOfTimeError
                    self._stop.wait(0.2)
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
            log.seek(0)
            return process.returncode, log.read()


def first_failed(summary: str) -> str:
    """Return the first test that pytest's summary names as failed; its parameters may hold spaces. Empty: none."""
    found = re.search(r"^(?:FAILED|ERROR) ([^\s\[]+\[.*?\](?= - |$)|\S+)", summary, re.MULTILINE)
    return found[1] if found else ""


def digest_of(root: Path, mutation: Mutation, tests: Iterable[str]) -> str:
    """Of a mutation, the text of its file and of tests; any change of them changes it."""
    total = hashlib.sha256(msgspec.json.encode(mutation))
    for name in [mutation.file, *tests]:
        path = root / name.partition("::")[0]
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            total.update(file.read_bytes() if file.exists() else b"")
    return total.hexdigest()[:16]


def read_log(path: Path) -> dict[str, Verdict]:
    """The newest verdict of each mutant in a log; a last line that was cut counts for nothing."""
    verdicts: dict[str, Verdict] = {}
    for line in path.read_bytes().splitlines() if path.exists() else []:
        try:
            verdict = msgspec.json.decode(line, type=Verdict)
        except msgspec.DecodeError:
            continue
        verdicts[verdict.name] = verdict
    return verdicts


def known_verdicts(mutations: Sequence[Mutation], log: Path, root: Path, limit_s: float) -> dict[str, Verdict]:
    """Verdicts of earlier runs that still hold; `unknown` where tests are left, or time is."""
    logged, known = read_log(log), dict[str, Verdict]()
    for mutation in (one for one in mutations if one.name in logged):
        verdict = logged[mutation.name]
        if verdict.digest != digest_of(root, mutation, verdict.ran):
            continue
        left = {test for stage in stages_of(root, mutation) for test in stage} - set(verdict.ran)
        if verdict.status != "killed" and left and not (verdict.status == "timed out" and verdict.seconds >= limit_s):
            verdict = msgspec.structs.replace(verdict, status="unknown")
        known[mutation.name] = verdict
    return known


class Campaign:
    """Mutants on their way through the stages, and what is known of each."""

    def __init__(
        self, mutations: Sequence[Mutation], known: dict[str, Verdict], log: Path, on_verdict: Callable[[Verdict], None]
    ) -> None:
        self.verdicts, self._log, self._on_verdict, self._lock = known, log, on_verdict, threading.Lock()
        self.stop = threading.Event()
        self._waiting: deque[Mutation] = deque()
        for mutation in mutations:
            verdict = known.get(mutation.name)
            if verdict is None or verdict.status == "unknown":
                self._waiting.append(mutation)
            else:
                on_verdict(verdict)
        log.parent.mkdir(parents=True, exist_ok=True)
        if log.exists() and not log.read_bytes().endswith(b"\n"):
            # a line that was cut must not take the next one with it
            log.write_bytes(log.read_bytes() + b"\n")

    def work(self, root: Path, limit_s: float) -> None:
        """Judge mutants in a copy of the tree until none waits."""
        with TemporaryDirectory(prefix="mutants-") as folder:
            workspace = Workspace(root, Path(folder), self.stop)
            while (mutation := self._next()) is not None:
                self._keep(mutation, workspace.judge(mutation, self.verdicts.get(mutation.name), limit_s))

    def _next(self) -> Mutation | None:
        with self._lock:
            return self._waiting.popleft() if self._waiting and not self.stop.is_set() else None

    def _keep(self, mutation: Mutation, verdict: Verdict) -> None:
        with self._lock:
            # what was cut short is no verdict
            if self.stop.is_set():
                return
            self.verdicts[verdict.name] = verdict
            with self._log.open("ab") as stream:
                stream.write(msgspec.json.encode(verdict) + b"\n")
            if verdict.status == "unknown":
                self._waiting.append(mutation)
            else:
                self._on_verdict(verdict)


def run(
    mutations: Sequence[Mutation],
    log: Path,
    root: Path = ROOT,
    jobs: int = 1,
    limit_s: float = 900.0,
    on_verdict: Callable[[Verdict], None] = lambda verdict: None,
) -> list[Verdict]:
    """Verdicts of mutations in their order, each in a copy of the tree; those that still hold come from the log.

    Raises `ValueError` before any test is run where a mutation does not fit its file.
    """
    for mutation in mutations:
        mutated((root / mutation.file).read_text(), mutation)
    campaign = Campaign(mutations, known_verdicts(mutations, log, root, limit_s), log, on_verdict)
    with ThreadPoolExecutor(jobs) as pool:
        try:
            for done in as_completed([pool.submit(campaign.work, root, limit_s) for _ in range(jobs)]):
                done.result()
        finally:
            campaign.stop.set()
    return [campaign.verdicts[mutation.name] for mutation in mutations]


def summary(verdicts: Sequence[Verdict]) -> dict[str, dict[str, int]]:
    """How many of each group were killed, survived, ran out of time."""
    counts: dict[str, dict[str, int]] = {}
    for verdict in verdicts:
        group = counts.setdefault(verdict.group, {"killed": 0, "survived": 0, "timed out": 0})
        group[verdict.status] += 1
    return counts


def as_json(mutations: Sequence[Mutation], verdicts: Sequence[Verdict]) -> str:
    """The list with what became of each, and the counts."""
    judged = {verdict.name: verdict for verdict in verdicts}
    rows = [
        {"name": one.name, "group": one.group, "file": one.file, "reason": one.reason, "status": "equivalent"}
        | (
            {}
            if one.name not in judged
            else {"status": judged[one.name].status, "killed_by": judged[one.name].killed_by}
        )
        for one in mutations
    ]
    return json.dumps({"counts": summary(verdicts), "mutations": rows}, indent=1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--list", type=Path, default=LIST, help="mutations (YAML)")
    parser.add_argument("--only", nargs="*", default=[], metavar="TEXT", help="those whose names contain a text")
    parser.add_argument("--group", choices=("guard", "reviewed", "drawn"))
    parser.add_argument("--jobs", type=int, default=1, help="mutants at a time, a core and a copy of the tree each")
    parser.add_argument("--limit", type=float, default=900.0, help="seconds a mutant")
    parser.add_argument("--log", type=Path, default=ROOT / "runs" / "mutations.jsonl", help="verdicts, to go on from")
    parser.add_argument("--fresh", action="store_true", help="judge all again")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    mutations = [
        one
        for one in load_list(arguments.list)
        if arguments.group in (None, one.group)
        and (not arguments.only or any(text in one.name for text in arguments.only))
    ]
    # ended from outside, it ends its tests and takes its copies away too
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if arguments.fresh:
        arguments.log.unlink(missing_ok=True)
    running = [one for one in mutations if not one.equivalent]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as progress:
        bar = progress.add_task("mutants", total=len(running))

        def show(verdict: Verdict) -> None:
            progress.advance(bar)
            line = f"{verdict.status:9s} {verdict.seconds:6.1f} s  {verdict.name}"
            print(line + (f"  <- {verdict.killed_by}" if verdict.killed_by else ""), file=sys.stderr, flush=True)

        verdicts = run(running, arguments.log, jobs=arguments.jobs, limit_s=arguments.limit, on_verdict=show)
    if arguments.json:
        print(as_json(mutations, verdicts))
    else:
        for group, counts in summary(verdicts).items():
            print(f"{group}: " + ", ".join(f"{count} {status}" for status, count in counts.items()))
        for verdict in verdicts:
            if verdict.status != "killed":
                print(f"{verdict.status}: {verdict.name}")
        for name in sorted({name for verdict in verdicts for name in verdict.unfit}):
            print(f"says nothing, fails in an unchanged copy of the tree or by chance: {name}")
    return int(any(verdict.status != "killed" for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
