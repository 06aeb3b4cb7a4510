"""Mutation testing: plausible bugs put into a copy of the sources, one at a time, and the tests that notice.

`benchmarks/mutations.yaml` lists the mutations: text of a file that stands there exactly once, what takes its place,
and the tests that should notice. Each mutant runs those tests first, then the test file of its module, those that
import the module, the rest of the tests that mirror its room, and `tests/stability`. It is killed by the first test
that fails on it twice and passes on the unchanged copy; tests that start processes of the graph are left out.
The tree itself is never written to. Mutants already judged are taken from the log unless they, their file or the tests
that ran have changed since. Exit code 1 where a mutant survives.
Usage: python -m benchmarks.mutations [--group reviewed] [--only NAME ...] [--jobs 2] [--limit 900] [--json]
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import msgspec
import yaml
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "benchmarks" / "mutations.yaml"
#: What a copy of the tree does without.
LEFT_OUT = shutil.ignore_patterns(".git", ".venv", ".*_cache", ".hypothesis", "runs", "out", "data", "build", "dist")
#: Sources of these rooms have tests that mirror them under another name.
MIRRORED_ROOMS = {"nodes/viewer": ("tests/viewer", "tests/nodes")}
LAST_STAGE = "tests/stability"


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
    """What became of a mutant: its status, the test that killed it, and the test files that ran."""

    name: str
    group: str
    status: Literal["killed", "survived", "timed out"]
    killed_by: str
    seconds: float
    ran: tuple[str, ...]
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


class _BlockDumper(yaml.SafeDumper):
    """Text of several lines as it stands."""


_BlockDumper.add_representer(
    str,
    lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None),
)


def as_yaml(mutations: Sequence[Mutation]) -> str:
    """Mutations as they stand in a list."""
    rows = [msgspec.to_builtins(mutation) for mutation in mutations]
    return yaml.dump(rows, Dumper=_BlockDumper, sort_keys=False, allow_unicode=True, width=1000)


def mutated(source: str, mutation: Mutation) -> str:
    """The text of a mutant's file; raises `ValueError` where the old text does not stand exactly once."""
    if (count := source.count(mutation.old)) != 1:
        raise ValueError(f"{mutation.file}: text of {mutation.name!r} must stand once, stands {count} times")
    return source.replace(mutation.old, mutation.new)


def module_of(file: str) -> str:
    """The import name of a source file."""
    return file.removesuffix(".py").replace("/", ".")


def test_stages(root: Path, mutation: Mutation) -> list[list[str]]:
    """Tests of a mutant in the order in which they run, none twice; those of one list run together."""
    path = Path(mutation.file)
    files = sorted(str(test.relative_to(root)) for test in (root / "tests").rglob("test_*.py"))
    own = [file for file in files if Path(file).stem.startswith(f"test_{path.stem}")]
    module = re.escape(module_of(mutation.file))
    package, _, stem = module.rpartition(r"\.")
    imports = re.compile(rf"\b{module}\b|from {package} import [^\n]*\b{stem}\b")
    importing = [file for file in files if imports.search((root / file).read_text())]
    rooms = [f"{folder}/" for folder in mirrored_rooms(path)]
    room = [file for file in files if file.startswith(tuple(rooms))]
    # a test that walks through the whole tree of sources or starts whole programs says nothing of one module
    importing = [file for file in importing if not file.startswith(("tests/docs/", "tests/fuzz/"))]
    stages, taken = [], set[str]()
    for stage in (list(mutation.tests), own, importing, room, [LAST_STAGE]):
        fresh = [test for test in dict.fromkeys(stage) if test not in taken]
        taken |= set(fresh)
        stages += [fresh] if fresh else []
    return stages


def mirrored_rooms(path: Path) -> tuple[str, ...]:
    """Folders of tests that mirror a source's room: of models the inner one's name, else the room's own."""
    folder = path.parent.as_posix()
    if folder in MIRRORED_ROOMS:
        return MIRRORED_ROOMS[folder]
    parts = path.parts
    return (f"tests/{parts[1] if parts[0] == 'models' else parts[0]}",)


class Workspace:
    """A copy of the tree in which one mutant at a time lives."""

    def __init__(self, root: Path, folder: Path, stop: threading.Event) -> None:
        self.root, self.folder, self._stop = root, folder / "tree", stop
        shutil.copytree(root, self.folder, ignore=LEFT_OUT)

    def judge(self, mutation: Mutation, limit_s: float) -> Verdict:
        """Run a mutant's tests until one kills it; raises `ValueError` where the mutation does not fit its file."""
        path, start_s = self.folder / mutation.file, time.monotonic()
        until_s = start_s + limit_s
        mutant = mutated(path.read_text(), mutation)
        ran: list[str] = []
        status: Literal["killed", "survived", "timed out"] = "survived"
        killed_by = ""
        with TemporaryDirectory(dir=self.folder.parent) as cache:
            path.write_text(mutant)
            try:
                for stage in test_stages(self.root, mutation):
                    ran += stage
                    if killed_by := self._killer(mutation, mutant, stage, until_s, Path(cache)):
                        status = "killed"
                        break
            except _OutOfTimeError:
                status = "timed out"
            finally:
                shutil.copy2(self.root / mutation.file, path)
        return Verdict(
            name=mutation.name,
            group=mutation.group,
            status=status,
            killed_by=killed_by,
            seconds=round(time.monotonic() - start_s, 1),
            ran=tuple(ran),
            digest=digest_of(self.root, mutation, ran),
        )

    def _killer(self, mutation: Mutation, mutant: str, tests: list[str], until_s: float, cache: Path) -> str:
        """The first test that fails on the mutant, twice, and passes on the unchanged copy; empty: none."""
        path, unfit = self.folder / mutation.file, list[str]()
        # kernels that were compiled of others inline what they call: none may outlast a change of it
        numba_cache = cache if "numba" in mutant or "njit" in mutant else None
        while failed := self._first_failure(tests, unfit, until_s, numba_cache):
            fails_again = bool(self._first_failure([failed], [], until_s, numba_cache))
            shutil.copy2(self.root / mutation.file, path)
            passes_unchanged = not self._first_failure([failed], [], until_s, None)
            path.write_text(mutant)
            if fails_again and passes_unchanged:
                return failed
            unfit.append(failed)
        return ""

    def _first_failure(self, tests: list[str], without: list[str], until_s: float, numba_cache: Path | None) -> str:
        """Name of the first test that fails; empty: none. A file that cannot be read as tests counts as one."""
        # no test of another module is put in its place by chance
        command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=no", "-p", "no:cacheprovider", "-m", "not graph"]
        command += ["-n", "0", *(f"--deselect={name}" for name in without), *tests]
        environment = os.environ | {"PYTHONPATH": str(self.folder), "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        environment |= {"MIRRORWAVE_RUN_DIR": str(self.folder.parent / "run")}
        environment |= {} if numba_cache is None else {"NUMBA_CACHE_DIR": str(numba_cache)}
        code, output = self._run(command, environment, until_s)
        if code in (0, 5):
            return ""
        names = re.findall(r"^(?:FAILED|ERROR) (\S+)", output, re.MULTILINE)
        # a mutant may end the whole process
        return names[0] if names else tests[0]

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


def digest_of(root: Path, mutation: Mutation, tests: Iterable[str]) -> str:
    """Of a mutation, the text of its file and of tests; any change of them changes it."""
    total = hashlib.sha256(msgspec.json.encode(mutation))
    for name in [mutation.file, *tests]:
        path = root / name.partition("::")[0]
        for file in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            total.update(file.read_bytes() if file.exists() else b"")
    return total.hexdigest()[:16]


def still_holds(root: Path, mutation: Mutation, verdict: Verdict) -> bool:
    """Whether a verdict of an earlier run is that of today: same mutation, same file, same tests."""
    if verdict.digest != digest_of(root, mutation, verdict.ran):
        return False
    names = {name for stage in test_stages(root, mutation) for name in stage}
    return verdict.status == "killed" or set(verdict.ran) == names


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


def run(
    mutations: Sequence[Mutation],
    log: Path,
    root: Path = ROOT,
    jobs: int = 1,
    limit_s: float = 900.0,
    on_verdict: Callable[[Verdict], None] = lambda verdict: None,
) -> list[Verdict]:
    """Verdicts of mutations in their order, each in a copy of the tree; those that still hold come from the log."""
    for mutation in mutations:
        mutated((root / mutation.file).read_text(), mutation)
    logged = read_log(log)
    verdicts = {one.name: logged[one.name] for one in mutations if one.name in logged}
    verdicts = {
        one.name: verdicts[one.name]
        for one in mutations
        if one.name in verdicts and still_holds(root, one, verdicts[one.name])
    }
    for verdict in verdicts.values():
        on_verdict(verdict)
    waiting: queue.SimpleQueue[Mutation] = queue.SimpleQueue()
    for mutation in mutations:
        if mutation.name not in verdicts:
            waiting.put(mutation)
    stop, lock = threading.Event(), threading.Lock()
    log.parent.mkdir(parents=True, exist_ok=True)

    def work() -> None:
        with TemporaryDirectory(prefix="mutants-") as folder:
            workspace = Workspace(root, Path(folder), stop)
            while not stop.is_set():
                try:
                    mutation = waiting.get_nowait()
                except queue.Empty:
                    return
                verdict = workspace.judge(mutation, limit_s)
                with lock:
                    if stop.is_set():
                        return
                    verdicts[mutation.name] = verdict
                    with log.open("ab") as stream:
                        stream.write(msgspec.json.encode(verdict) + b"\n")
                    on_verdict(verdict)

    workers = min(jobs, waiting.qsize())
    with ThreadPoolExecutor(max(workers, 1)) as pool:
        try:
            done = [pool.submit(work) for _ in range(workers)]
            for future in done:
                future.result()
        finally:
            stop.set()
    return [verdicts[mutation.name] for mutation in mutations]


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
    return int(any(verdict.status != "killed" for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
