"""Command blocks of the documentation, and how they are run: page by page, top to bottom, as a reader would.

A page's commands run in one folder that has the checkout's files and some recordings, data and runs beside them. What
would take minutes runs in its short form: `SHORTER` lists every change, nothing is left out silently.
"""

from __future__ import annotations

import configparser
import contextlib
import importlib.util
import io
import itertools
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tomllib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import yaml
from markdown_it import MarkdownIt

from mirrorwave.cli import main
from mirrorwave.commands.graph.nodes import collect_heartbeats
from msgs.bus.zmq import run_dir
from msgs.files.shipped import CHECKOUT
from msgs.values.diagnostics import NodeState

ROOT = CHECKOUT
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # tests in the background of a shell: what is started from here would not hear the Ctrl-C that ends it
    signal.signal(signal.SIGINT, signal.default_int_handler)
#: A graph that the documentation starts in the background gets this long to be ready.
READY_S = 600.0
#: Who hears nothing in a second or two, on a machine with much else to do, listens longer.
LISTENS, LONGER_S = re.compile(r"mirrorwave topic (hz|bw|delay) .*--duration \d+$"), ("4", "16", "64")
UP = (NodeState.READY, NodeState.DEGRADED)

#: Programs that a reader may have and a test machine need not.
OPTIONAL = ("node", "npm", "cc", "./my_node")
#: Libraries that a C compiler has to find.
C_LIBRARIES = ("libzmq", "msgpack")
#: Folder of a page into which packages are installed, those of the checkout by their entry points alone: their wheels
#: are installed in tests/examples/test_installed.py. What speaks of them is known to a new process alone.
INSTALLED, EXAMPLE, OF_AN_EXAMPLE = (
    "installed",
    re.compile(r"pip install \./(\S+)"),
    re.compile(r"\bmy[_/](?!detector)|yard|doctor"),
)
#: A machine that has no DDS shows the bridge's graph instead.
WITHOUT_DDS: tuple[tuple[str, str], ...] = (
    () if importlib.util.find_spec("cyclonedds") else ((r"^mirrorwave launch (\S+_ros2\S+)$", r"mirrorwave graph \1"),)
)
#: (pattern, replacement): what is changed in a command before it is run, in this order. Sizes and times only, or the
#: same verb on what is small; `make` says what it would do.
SHORTER: tuple[tuple[str, str], ...] = (
    (r"^make (?!-n)", "make -n "),
    (r"^pip install (\w+)$", r"python -c 'import \1'"),
    # the environment of the tests may have been installed before the plug-in was
    (r"^pytest (\S+)$", r"python -m pytest -q -p mirrorwave.testing.fixtures \1"),
    (r"^mirrorwave demo$", "mirrorwave demo --headless --duration 1"),
    # README processes the sample, tests/mirrorwave/commands/captures/test_process.py serves its pages
    (r"^mirrorwave (?:(process) --sample --view|(view) --sample)$", r"mirrorwave \1\2 --help"),
    (r"^timeout (.*) 20 ", r"timeout \1 5 "),
    # tests/docs/test_notebook.py runs it
    (r"^jupyter execute (\S+)$", r"test -f \1"),
    (r"--duration \d+", "--duration 2"),
    (r"^(mirrorwave (?:launch|demo|topic) .*--duration) 2", r"\1 1"),
    # the default profile processes the sample
    (r"^(mirrorwave process (?!--|.*--profile).*)$", r"\1 --profile cfar"),
    (r"--window 10\b", "--window 2"),
    (r"^(mirrorwave sim run .*)$", r"\1 --chirps-per-beam 8"),
    (r"^(python -m benchmarks\S+ --record .*)$", r"\1 --chirps 2"),
    (r"--scans \d+", "--scans 2"),
    *WITHOUT_DDS,
    # two machines in one folder; the nodes that link them run in tests/contrib/two_machines/test_link.py
    (r"^scp keys/(\S+) \w+:(\S+)$", r"cp keys/\1 \2"),
    (r"^mirrorwave launch (launch/two_hosts_\S+).*$", r"mirrorwave graph \1"),
    (r"^mirrorwave launch (launch/\S+)(?!.*--duration)(.*)$", r"mirrorwave launch \1 --duration 1\2"),
    # a LiDAR has no chirps
    (
        r"^mirrorwave launch (launch/(?:corner(?!_spad)|side_street)\S*)(.*)$",
        r"mirrorwave launch \1 -p player.chirps_per_beam=8\2",
    ),
    (r"^mirrorwave top( --once)?$", "mirrorwave top --once --window 1"),
    (r"^(mirrorwave topic (hz|bw|delay)(?!.*--duration).*)$", r"\1 --duration 1"),
    # the fewest places of which two are to train on, beside one for validation and one for the test
    (r"--count \d+", "--count 4"),
    # drives, which are many scans each; no page trains on them
    (r"^(mirrorwave sim dataset .*--count) 4 (--scans .*)$", r"\1 2 \2"),
    (r"^(mirrorwave topic echo .*)--count 4", r"\1--count 2"),
    (r"--workers 2", "--workers 1"),
    (r"^(mirrorwave train dense .*)$", r"\1 --epochs 1 --batch-size 2 --limit 2"),
    (r"^(mirrorwave train objects .*)$", r"\1 --epochs 1"),
    # after one epoch there are no candidates: tests/lab/training/evidence/test_train_candidates.py trains on some
    (r"^(mirrorwave train candidates) .*$", r"\1 --help"),
    # all rows, and those of the simulator: tests/lab/tradeoff
    (r"^(mirrorwave tradeoff)(?!.*--row)(.*)$", r"\1\2 --help"),
    (r"^(mirrorwave tradeoff) --row chirps(.*)$", r"\1\2 --count 1 --no-memory"),
    # the other machine is this one: what SSH forwards is relayed between two sockets here
    (r"^ssh -N -L (\$XDG\S+) vehicle( &)?$", r"python -m tests.docs.relay \1\2"),
    (r"^ssh -N -L 8765:127.0.0.1:8765 vehicle$", "mirrorwave view --help"),
    (r"^scp vehicle:(\S+) \.$", r"test -f \1"),
    (r"/run/user/1000", "$XDG_RUNTIME_DIR"),
    (r"-i socketcan -c can0", "-i virtual -c docs --duration 1"),
    (r"^(mirrorwave eval .*)$", r"\1 --limit 2"),
)


class Block(NamedTuple):
    """A block of code of a page."""

    page: Path
    line: int
    language: str
    text: str


def blocks_of(page: Path) -> list[Block]:
    """Every block of code of a page, in order; what is not said of its language is told from its text."""
    tokens = MarkdownIt().parse(page.read_text(encoding="utf-8"))
    found = [token for token in tokens if token.type in ("fence", "code_block")]
    return [
        Block(page, (token.map or [0])[0] + 1, token.info.strip() or _language(token.content), token.content)
        for token in found
    ]


def _language(text: str) -> str:
    programs = "mirrorwave|python|pip|pytest|make|source|ssh|scp|npm|mkdir|jupyter"
    if re.search(rf"^([A-Z_]+=\S+ )?({programs}) \S", text, re.MULTILINE):
        return "sh"
    if re.search(r"^(import|from) \w", text, re.MULTILINE):
        return "python"
    with contextlib.suppress(yaml.YAMLError):
        if isinstance(yaml.safe_load(text), dict) and not text.lstrip().startswith("{"):
            return "yaml"
    return "text"


def commands_of(text: str) -> Iterator[tuple[int, str]]:
    """(line, command) of a shell block: comments off, continued lines joined, activation left out."""
    joined = re.sub(r"\\\n", lambda _match: " \0", text)
    line = 1
    for raw in joined.split("\n"):
        command = " ".join(shlex.join(_words(raw)).split()) if raw.strip() else ""
        if command and not command.startswith("source "):
            yield line, _raw_words(raw)
        line += 1 + raw.count("\0")


def _words(raw: str) -> list[str]:
    return shlex.split(raw.replace("\0", ""), comments=True)


def _raw_words(raw: str) -> str:
    """The command as written, without its comment."""
    lexer = shlex.shlex(raw.replace("\0", ""), posix=False)
    lexer.whitespace_split, lexer.commenters = True, "#"
    return " ".join(lexer)


def shortened(command: str) -> str:
    """The form in which a command is run."""
    for pattern, replacement in SHORTER:
        command = re.sub(pattern, replacement, command)
    return command


class Runner:
    """Runs the blocks of one page in a folder."""

    def __init__(self, folder: Path, launched: dict[str, Path | None]) -> None:
        self._folder = folder
        #: Launch files whose graph ran already, on this page or another: other options of it are checked alone, and its
        #: recording, if there is one, is what another one would be.
        self._launched = launched
        self._background: list[subprocess.Popen[str]] = []
        #: The command of the graph among them.
        self._graph = ""
        #: Programs of `OPTIONAL` that a command would have needed.
        self.missing: list[str] = []

    def run_page(self, blocks: list[Block]) -> None:
        """Run a page's blocks, top to bottom; those of Python that follow each other in one process, each by itself."""
        for language, row in itertools.groupby(enumerate(blocks, 1), lambda item: item[1].language):
            if language == "python":
                self._python([block for _, block in row])
            else:
                for number, block in row:
                    self._run(block, blocks[number:])

    def _run(self, block: Block, later: list[Block]) -> None:
        """Run a block; a failure names page, line and command."""
        where = f"{block.page.relative_to(ROOT)}:{block.line}"
        if block.language in ("sh", "bash"):
            self._shell(block, where, later)
        elif block.language == "yaml":
            assert yaml.safe_load(block.text) is not None, where

    @contextlib.contextmanager
    def beside(self, command: str) -> Iterator[None]:
        """Run the body while a command, if any, runs in the background."""
        if command:
            self._command(command, "beside the page")
        started, self._background = self._background, []
        try:
            yield
        finally:
            self._background += started
            self.close()

    def close(self) -> None:
        """End what runs in the background."""
        for process in self._background:
            process.send_signal(signal.SIGINT)
        for process in self._background:
            output, _ = process.communicate(timeout=120)
            assert process.returncode == 0, f"ended with {process.returncode}: {process.args}: {output[-2000:]}"
        self._background.clear()
        self._graph = ""

    def _shell(self, block: Block, where: str, later: list[Block]) -> None:
        is_wanted = False
        try:
            for line, command in commands_of(block.text):
                self._command(command, f"{where}+{line - 1}")
            is_wanted = self._graph in _backgrounds(later)
        finally:
            # a graph that a later block starts again runs on until then
            if not is_wanted:
                self.close()

    def _command(self, written: str, where: str) -> None:
        background = written.endswith("&")
        command = shortened(written.rstrip("& "))
        words = [word for word in shlex.split(command) if not re.match(r"[A-Z_]+=", word)]
        is_new = (self._folder / INSTALLED).exists() and OF_AN_EXAMPLE.search(command)
        plain = command.startswith("mirrorwave ") and "|" not in words and not is_new
        if example := EXAMPLE.fullmatch(command):
            install(ROOT / example[1], self._folder / INSTALLED)
            return
        if words[0] in OPTIONAL and self._is_missing(words[0]):
            self.missing.append(words[0])
            return
        if background and command == self._graph:
            return
        if words[1:2] == ["launch"]:
            # by then the graph before it has ended by itself
            self.close()
        if background or _serves_page(words):
            self._start(words, command)
            self._graph = command if words[1:2] == ["launch"] else self._graph
            return
        recording = self._folder / words[words.index("--record") + 1] if "--record" in words else None
        is_again = words[1:2] == ["launch"] and words[2] in self._launched and "--split-duration" not in words
        earlier = self._launched[words[2]] if is_again and recording else None
        is_again &= recording is None or earlier is not None
        # of a command that is interrupted on purpose the moment decides which
        ended = (0, 130) if "--signal INT" in command else (0,)
        for longer in ("", *LONGER_S) if LISTENS.match(command) else ("",):
            command = re.sub(r"\d+$", longer, command) if longer else command
            with checked_alone() if is_again else contextlib.nullcontext():
                if plain:
                    code, output = self._mirrorwave(shlex.split(command)[1:])
                else:
                    # a package's graph has no other options
                    code, output = (0, "") if is_again else self._process(command)
            if code in ended:
                break
        assert code in ended, f"{where}: {command!r} ended with {code}: {output[-2000:]}"
        if earlier and recording:
            shutil.copy(self._folder / earlier, recording)
        elif words[1:2] == ["launch"]:
            self._launched[words[2]] = self._launched.get(words[2]) or recording

    def _is_missing(self, program: str) -> bool:
        if "/" in program:
            # a page makes it, with what may be missing
            return not (self._folder / program).exists()
        return shutil.which(program) is None or (program == "cc" and not has_c_libraries())

    def _mirrorwave(self, arguments: list[str]) -> tuple[int, str]:
        """In this process, where packages are loaded already."""
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)}
        output = io.StringIO()
        try:
            with contextlib.chdir(self._folder), contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
                code = main(arguments)
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        return code, output.getvalue()

    def _process(self, command: str) -> tuple[int, str]:
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=self._folder,
            env=_environment(self._folder),
            capture_output=True,
            text=True,
            check=False,
        )
        return done.returncode, done.stdout + done.stderr

    def _python(self, blocks: list[Block]) -> None:
        """In this process, whose warnings are errors; of views the first two."""
        for block in blocks:
            text = re.sub(r"^for view in (views\(.*\)):$", r"for _, view in zip(range(2), \1):", block.text, flags=re.M)
            code = compile(text, f"{block.page.relative_to(ROOT)}:{block.line}", "exec", dont_inherit=True)
            with contextlib.chdir(self._folder), warnings.catch_warnings():
                # a file that a line opens is closed when the line is over
                warnings.simplefilter("ignore", ResourceWarning)
                exec(code, {"__name__": "__main__"})

    def _start(self, words: list[str], command: str) -> None:
        """Start in the background, with as long to run as the page's foreground needs."""
        verb = words[1] if words[0] == "mirrorwave" else ""
        if _serves_page(words):
            command += " --no-browser --port 0"
        process = self._popen(re.sub(r"--duration \d+", "", command))
        self._background.append(process)
        if verb == "launch":
            # without a source there are no views until `bag play` sends beams
            _wait_until_ready(process, has_source="launch/replay.yaml" not in words)
        elif _serves_page(words):
            assert process.stdout is not None
            lines = iter(process.stdout.readline, "")
            assert any("open http" in line for line in lines), f"{command}: no address"
        else:
            time.sleep(1.0)

    def _popen(self, command: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            ["bash", "-c", f"exec env {command}"],
            cwd=self._folder,
            env=_environment(self._folder),
            stdout=subprocess.PIPE,
            text=True,
        )


def checked_alone() -> contextlib.AbstractContextManager[object]:
    """Have `launch` read its file and options, and ask its nodes whether they take them; no graph is started."""
    return mock.patch("mirrorwave.commands.graph.launch.run_graph", return_value=0)


def install(example: Path, folder: Path) -> None:
    """Make modules and entry points of a package known to processes that have the folder on their path."""
    project = tomllib.loads((example / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    about = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    about.mkdir(parents=True)
    for module in example.glob("*.py"):
        (folder / module.name).symlink_to(module)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    points = configparser.ConfigParser()
    points.read_dict(project["entry-points"])
    with (about / "entry_points.txt").open("w") as file:
        points.write(file)


def has_c_libraries() -> bool:
    """Return whether a C compiler finds `C_LIBRARIES`."""
    query = ["pkg-config", "--exists", *C_LIBRARIES]
    return shutil.which(query[0]) is not None and subprocess.run(query, check=False).returncode == 0


def _serves_page(words: list[str]) -> bool:
    """Return whether a command serves a recording's page until Ctrl-C."""
    verb = words[1] if words[0] == "mirrorwave" and "--help" not in words else ""
    return verb == "view" or (verb == "process" and "--view" in words)


def _backgrounds(blocks: list[Block]) -> set[str]:
    """Commands that blocks start in the background, in the form in which they are run."""
    commands = [command for block in blocks if block.language == "sh" for _, command in commands_of(block.text)]
    return {shortened(command.rstrip("& ")) for command in commands if command.endswith("&")}


def _environment(folder: Path) -> dict[str, str]:
    """Variables of a page's processes: the programs of the tests' environment, and what the page has installed."""
    modules = filter(None, [str(folder / INSTALLED), os.environ.get("PYTHONPATH")])
    programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return {**os.environ, "PATH": programs, "PYTHONPATH": os.pathsep.join(modules)}


def _wait_until_ready(process: subprocess.Popen[str], has_source: bool) -> None:
    """Until all are up and, where there is a source, a view came: the last node of a graph is then up.

    On a machine with much else to do some are up and behind, DEGRADED, as long as it lasts.
    """
    deadline_s = time.monotonic() + READY_S
    while time.monotonic() < deadline_s:
        assert process.poll() is None, f"the graph ended with {process.returncode}"
        beats = collect_heartbeats(run_dir("default"), 0.6)
        states = {name: found[-1].state for name, found in beats.items()}
        seen = sum(
            count.messages
            for found in beats.values()
            for count in found[-1].published
            if count.topic == "perception/hidden_objects"
        )
        if states and (seen or not has_source) and all(state in UP for state in states.values()):
            return
    raise TimeoutError(f"no graph in {READY_S:g} s")
