"""The command line: one verb group a module, one place where errors become one line and an exit code."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import sys
from typing import Annotated, Any

import typer
import typer.core

# BLAS threads cost more than they bring on matrices of this size; must be said before numpy is imported
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from mirrorwave.commands.former_options import present_words
from mirrorwave.commands.verbs import loaded, plugged_in
from mirrorwave.console import ExitCode, error_line, exit_code_of
from mirrorwave.exit_signals import INTERRUPTED, ended_by_signal, was_interrupted
from mirrorwave.terminal import READER_LEFT
from msgs.files.open_files import raise_open_files
from msgs.files.plugins import VERBS, plugins
from nodes.process.kernel_cache import use_fallback
from nodes.process.machine import installed_version

#: Verbs and groups as the help lists them, each with an example.
_PANELS = {
    "Start here": {"demo": "demo --duration 30", "process": "process --sample --view", "view": "view seen.mcap"},
    "Run a graph": {
        "launch": "launch launch/corner.yaml --duration 60",
        "top": "top --once",
        "node": "node list",
        "topic": "topic echo perception/hidden_objects --once",
        "param": "param set geometry object_threshold=0.5",
        "graph": "graph launch/corner.yaml",
        "doctor": "doctor",
        "security": "security check launch/corner.yaml",
    },
    "Recordings and the data of others": {
        "bag": "bag record seen.mcap --duration 10",
        "import": "import sigmf capture.sigmf-meta --out capture.mcap",
        "can": "can decode drive.log",
        "calibrate": "calibrate background field.mcap --out background.npy",
        "annotate": "annotate scene.yaml --out labelled",
    },
    "Simulate": {"sim": "sim run launch/scenes/corner.yaml --out corner.mcap"},
    "Train and measure": {
        "train": "train dense --data data/places --out runs/dense",
        "export": "export runs/dense --out dense.onnx",
        "eval": "eval --objects --count 20",
        "tradeoff": "tradeoff --quick",
        "compare": "compare --quick",
    },
}
_NAME = "mirrorwave"
_EXAMPLES = {name: example for panel in _PANELS.values() for name, example in panel.items()}
_NAME_WIDTH = max(map(len, _EXAMPLES))
#: Verb -> module and function; a module is thin and imports what is heavy inside its functions.
_VERBS = {
    "demo": "mirrorwave.commands.graph.demo:demo",
    "launch": "mirrorwave.commands.graph.launch:launch",
    "process": "mirrorwave.commands.captures.process:process",
    "view": "mirrorwave.commands.captures.view:view",
    "export": "lab.commands.export:export",
    "eval": "lab.commands.evaluate:evaluate",
    "tradeoff": "lab.commands.tradeoff:tradeoff",
    "compare": "lab.commands.compare:compare",
    "doctor": "mirrorwave.commands.graph.doctor:doctor",
    "top": "mirrorwave.commands.graph.top:top",
    "graph": "mirrorwave.commands.graph.graph:graph",
    "annotate": "contrib.annotate.verb:annotate",
}
#: Options that mean the same in every verb that has them: explained once, a verb's help names those it takes.
COMMON_OPTIONS = {
    "--json": "Print JSON instead of a table.",
    "--domain": "Graph to talk to [default; environment variable MIRRORWAVE_DOMAIN].",
    "--window": "Seconds to listen to the graph [two heartbeats of each node or more].",
    "--workers": "Processes that work at a time [1].",
    "--threads": "Threads of a network that is trained or run [1].",
    "--plot": "File of a picture of the result (png, svg, pdf).",
    "--seed": "Seed of what is random; the same seed gives the same bytes [0].",
}
#: Verb group -> module and `typer.Typer`.
_GROUPS = {
    "sim": "mirrorwave.commands.sim.group:app",
    "train": "lab.commands.train:app",
    "bag": "mirrorwave.commands.captures.bag:app",
    "calibrate": "contrib.calibrate.verb:app",
    "can": "mirrorwave.commands.captures.can:app",
    "import": "mirrorwave.commands.captures.imports:app",
    "topic": "mirrorwave.commands.graph.topics:app",
    "node": "mirrorwave.commands.graph.nodes:app",
    "param": "mirrorwave.commands.graph.params:app",
    "security": "contrib.two_machines.verb:app",
}

#: Wrong usage, as the command line parser below typer raises it; typer brings its own copy or takes the installed one.
_USAGE_ERROR: type[Exception] = typer.BadParameter.__bases__[0]


class WholeHelp(typer.core.TyperGroup):
    """A group whose help says of each verb all that the verb's own help begins with; typer's ends with an ellipsis."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in order, each verb told to be described whole."""
        _describe_whole(self)
        return super().list_commands(ctx)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a verb; one that is a group itself describes its verbs whole too."""
        command = super().get_command(ctx, cmd_name)
        if isinstance(command, typer.core.TyperGroup):
            _describe_whole(command)
            for inner in command.commands.values():
                _hide_common_options(inner)
        elif command is not None:
            _hide_common_options(command)
        if command is not None and self.name == _NAME and cmd_name in _EXAMPLES:
            example = f"Example: mirrorwave {_EXAMPLES[cmd_name]}"
            command.epilog = "\n\n".join(filter(None, (command.epilog, example)))
        return command

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List the verbs of the whole command line by what they are for, each with an example."""
        if self.name != _NAME:
            super().format_commands(ctx, formatter)
            return
        for title, verbs in _PANELS.items():
            with formatter.section(title):
                for name, example in verbs.items():
                    if (command := self.get_command(ctx, name)) is not None:
                        formatter.write_dl([(name.ljust(_NAME_WIDTH), command.get_short_help_str(1000))])
                        formatter.write(f"{'':{formatter.current_indent + _NAME_WIDTH + 2}}$ mirrorwave {example}\n")
        if brought := [name for name in self.list_commands(ctx) if name not in _EXAMPLES]:
            with formatter.section("Of other packages"):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(1000)) for name in brought])
        with formatter.section("Options of many verbs"):
            formatter.write_dl(list(COMMON_OPTIONS.items()))


def _hide_common_options(command: Any) -> None:
    """Leave common options out of a verb's list; the end of its help names them."""
    usual = (None, False, 0, 1, "default")
    common = [option for option in command.params if COMMON_OPTIONS.keys() & set(option.opts) and not option.required]
    # what differs from verb to verb is explained there, but for how long each listens
    common = [option for option in common if option.default in usual or "--window" in option.opts]
    if common:
        command.epilog = f"Common options (see mirrorwave --help): {', '.join(option.opts[0] for option in common)}"
    for option in common:
        option.hidden = True


def _describe_whole(group: typer.core.TyperGroup) -> None:
    for command in group.commands.values():
        if command.help and not command.short_help:
            # a short help that is given is wrapped, one that is made from the long one is cut
            command.short_help = " ".join(command.help.strip().split("\n\n")[0].split())


def _version(wanted: bool) -> None:
    if wanted:
        sys.stdout.write(f"mirrorwave {version()}\n")
        raise typer.Exit


def _options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Sees what stands behind the corner, in the mirror of a wall."""


def version() -> str:
    """Version of the installed project, or "unknown" in a bare checkout."""
    return installed_version("mirrorwave") or "unknown"


@functools.cache
def command_line(verb: str = "") -> typer.Typer:
    """Return the command line of one verb or verb group, read in a third of the time; by default of all."""
    app = typer.Typer(
        name=_NAME,
        cls=WholeHelp,
        help="Sees what stands behind the corner, in the mirror of a wall.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        # verbs and groups take over the names of their parent
        context_settings={"help_option_names": ["-h", "--help"]},
        rich_markup_mode=None,
    )
    app.callback()(_options)
    for name, target in _VERBS.items():
        if verb in ("", name) and (function := loaded(target)) is not None:
            app.command(name)(function)
    for name, target in _GROUPS.items():
        if verb in ("", name) and (group := loaded(target)) is not None:
            app.add_typer(group, name=name, cls=WholeHelp)
    if verb not in _VERBS | _GROUPS:
        for name, group in plugged_in(verb).items():
            if name not in _VERBS | _GROUPS:
                app.add_typer(group, name=name, cls=WholeHelp)
    return app


def _understood(words: list[str]) -> list[str]:
    """Return a command line with `help` before, between or behind its verbs as --help."""
    at = words.index("help") if "help" in words[:3] else None
    if at is not None and (words[0] in _GROUPS or (at < 2 and set(words[:at]) <= _VERBS.keys())):
        return [*words[:at], *words[at + 1 :], "--help"]
    return words


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns its exit code: 0 done, 1 failed, 2 wrong usage or bad input, 3 done with loss.

    Of a verb that a signal ended before it was done: 128 and the signal's number (docs/guides/watch-a-graph.md); 141
    where the reader of its output has left.
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s: %(message)s")
    raise_open_files()
    # recordings and results show streets and people: what is written is for this user alone (SECURITY.md)
    before = os.umask(0o077)
    try:
        code = _run(argv)
    finally:
        os.umask(before)
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        code = _without_output(READER_LEFT)
    except OSError as error:
        code = _without_output(_fail(f"standard output: {error.strerror}", ExitCode.FAILED))
    return code


def _run(argv: list[str] | None) -> int:
    try:
        use_fallback()
        words = present_words(_understood(sys.argv[1:] if argv is None else argv), _say)
        code = command_line(
            words[0] if words and (words[0] in _VERBS | _GROUPS or words[0] in plugins(VERBS).usable) else ""
        )(args=words, prog_name="mirrorwave", standalone_mode=False)
        # what typer makes of an interrupt; other versions let it through
        if code == INTERRUPTED:
            return ended_by_signal(argv)
        return int(code) if isinstance(code, int) else ExitCode.DONE
    except (KeyboardInterrupt, typer.Abort) as end:
        # typer takes a file that ends early for the end of what is typed
        if isinstance(end.__cause__, EOFError) and not was_interrupted():
            return _fail(error_line(end.__cause__), ExitCode.FAILED)
        return ended_by_signal(argv)
    except _USAGE_ERROR as error:
        text = error.format_message() if hasattr(error, "format_message") else str(error)
        # a group without a verb answers with its help, which is no error line
        return _fail(text, ExitCode.BAD_INPUT, prefix="" if "\n" in text else "mirrorwave: ")
    except SystemExit as end:
        # what typer, and rich, make of a pipe that nobody reads any more
        if not isinstance(end.__context__, BrokenPipeError):
            raise
        return _without_output(READER_LEFT)
    except BrokenPipeError:
        return _without_output(READER_LEFT)
    except Exception as error:
        if was_interrupted():
            return ended_by_signal(argv)
        # the border of the program: whatever went wrong leaves it as one line and a code
        logging.getLogger(__name__).debug("traceback", exc_info=error)
        return _fail(error_line(error), exit_code_of(error))


def _say(line: str) -> None:
    _fail(line, ExitCode.DONE)


def _without_output(code: int) -> int:
    """Give what was not printed to nobody: the interpreter must not find out again while it exits."""
    # not sys.stdout: typer and rich put something in its place
    for stream in filter(None, (sys.__stdout__, sys.__stderr__)):
        try:
            stream.flush()
        except OSError:
            with open(os.devnull, "wb") as nowhere:
                os.dup2(nowhere.fileno(), stream.fileno())
    return code


def _fail(line: str, code: ExitCode, prefix: str = "mirrorwave: ") -> int:
    # where stderr has gone too, the code says it all
    with contextlib.suppress(OSError):
        sys.stderr.write(f"{prefix}{line}\n")
        sys.stderr.flush()
    return code


if __name__ == "__main__":
    sys.exit(main())
