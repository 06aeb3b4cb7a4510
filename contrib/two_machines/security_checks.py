"""Checks of `mirrorwave security check`: run directory, keys, launch file, listeners of the running graph."""

from __future__ import annotations

import ipaddress
import itertools
import os
import stat
from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from msgs.files.shipped import CHECKOUT
from msgs.values.wording import counted

if TYPE_CHECKING:
    import psutil

    from nodes.process.launch_file import NodeEntry

LINK_MODULE = "contrib.two_machines.link"
#: Where `keygen` puts keys unless told otherwise.
KEYS = Path("keys")
#: The last known holes of libzmq in encrypted sockets were closed with it.
_LEAST_ZEROMQ = (4, 3, 3)
#: A variable that begins so makes a process load other code.
_LOADS_CODE = ("LD_", "DYLD_", "PYTHON")
_HARMLESS = frozenset({"PYTHONUNBUFFERED", "PYTHONHASHSEED", "PYTHONFAULTHANDLER", "PYTHONWARNINGS", "PYTHONUTF8"})
#: A variable of this name moves the graph's meeting place.
_MOVES_GRAPH = frozenset({"MIRRORWAVE_RUN_DIR", "XDG_RUNTIME_DIR"})
#: CAN interfaces that carry frames over the network, open to whoever is on it.
_CAN_OVER_NETWORK = frozenset({"udp_multicast", "socketcand"})
#: Endings of files that show what the sensors saw, or hold a log.
_KINDS = (".mcap", ".sigmf-meta", ".sigmf-data", ".jsonl", ".npz")
#: Levels below the working directory that are looked at, and entries in all.
_LEVELS, _MAX_ENTRIES = 4, 20_000


class Grade(StrEnum):
    """Outcome of a check; only a problem makes the command fail."""

    OK = "ok"
    WARNING = "warning"
    PROBLEM = "problem"


class Risk(NamedTuple):
    """Finding of a check, and the one line that mends it."""

    check: str
    status: Grade
    detail: str
    mend: str = ""


def all_findings(launch_file: Path | None, domain: str) -> list[Risk]:
    """Every check in a fixed order; ValueError or OSError where launch file or domain are none."""
    from msgs.bus.zmq import run_dir
    from nodes.process.launch_file import expect_topics, read_launch_file

    meeting_place = run_dir(domain)
    launch = None if launch_file is None else read_launch_file(launch_file)
    if launch is not None:
        expect_topics(launch, str(launch_file))
    findings = [*check_user(os.geteuid()), *check_zeromq(), *check_run_dir(meeting_place), *check_keys(KEYS)]
    findings += check_files(Path.cwd())
    for name, entry in launch.nodes.items() if launch is not None else ():
        findings += check_node(name, entry)
    # a key of the launch file may be one of the folder's
    return list(dict.fromkeys([*findings, *check_graph(meeting_place)]))


def check_user(user: int) -> Iterator[Risk]:
    """Nobody needs root to run a graph."""
    if user == 0:
        mend = "run it as a user of its own; give that user the groups of its devices"
        yield Risk("user", Grade.WARNING, "this is root: a node that is taken over owns the machine", mend)
    else:
        yield Risk("user", Grade.OK, f"user {user}")


def check_zeromq() -> Iterator[Risk]:
    """The library of the bus is new enough and can encrypt."""
    import zmq

    mend = "pip install --upgrade pyzmq"
    if zmq.zmq_version_info() < _LEAST_ZEROMQ:
        least = ".".join(map(str, _LEAST_ZEROMQ))
        yield Risk("zeromq", Grade.PROBLEM, f"libzmq {zmq.zmq_version()} has known holes, {least} has not", mend)
    elif not zmq.has("curve"):
        yield Risk("zeromq", Grade.PROBLEM, f"libzmq {zmq.zmq_version()} was built without encryption (CURVE)", mend)
    else:
        yield Risk("zeromq", Grade.OK, f"libzmq {zmq.zmq_version()}, with CURVE")


def check_run_dir(folder: Path) -> Iterator[Risk]:
    """The meeting place belongs to us alone and nobody can put another in its place."""
    check = "run directory"
    risks = [risk for parent in _parents(folder) if (risk := _check_parent(parent, parent == folder.absolute().parent))]
    if not os.path.lexists(folder):
        yield from risks or [Risk(check, Grade.OK, f"{folder} is not there yet")]
        return
    facts = folder.lstat()
    if not stat.S_ISDIR(facts.st_mode):
        risks.append(Risk(check, Grade.PROBLEM, f"{folder} is no directory", f"rm {folder}"))
    elif facts.st_uid != os.geteuid():
        detail = f"{folder} belongs to user {facts.st_uid}: all messages go through their hands"
        risks.append(Risk(check, Grade.PROBLEM, detail, "export MIRRORWAVE_RUN_DIR=<a directory of your own>"))
    else:
        if facts.st_mode & 0o077:
            detail = f"{folder} is open to others, mode {stat.S_IMODE(facts.st_mode):04o}"
            risks.append(Risk(check, Grade.PROBLEM, detail, f"chmod 700 {folder}"))
        risks += _check_entries(folder)
    yield from risks or [Risk(check, Grade.OK, f"{folder} is ours alone")]


def check_keys(folder: Path) -> Iterator[Risk]:
    """Every secret key of a folder, and the lists of peers in it, can be used."""
    if not folder.is_dir():
        return
    for secret in sorted(folder.glob("*.key_secret")):
        yield _check_own(secret)
    for inner in sorted(path for path in folder.iterdir() if path.is_dir()):
        yield _check_allowed(inner)


def check_files(folder: Path) -> Iterator[Risk]:
    """Recordings, results and run folders can be read by nobody else; a checkout's own files are no user's."""
    opened: dict[str, list[Path]] = {}
    for path in itertools.islice(_open_below(folder, 0), _MAX_ENTRIES):
        top, *inside = path.relative_to(folder).parts
        mend = f"chmod -R go-rwx {folder / top}" if inside else f"chmod go-rwx {folder / f'*{path.suffix}'}"
        opened.setdefault(mend, []).append(path)
    for mend, (example, *more) in opened.items():
        count, mode = counted(1 + len(more), "file"), stat.S_IMODE(example.lstat().st_mode)
        detail = f"others may read {count} where they get to, e.g. {example}, mode {mode:04o}"
        yield Risk("files", Grade.WARNING, detail, mend)
    if not opened:
        yield Risk("files", Grade.OK, f"recordings, results and runs of {folder} are ours alone")


def _open_below(folder: Path, level: int) -> Iterator[Path]:
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except OSError:
        return
    for entry in entries:
        try:
            mode = entry.stat(follow_symlinks=False).st_mode
        except OSError:
            continue
        if stat.S_ISDIR(mode):
            is_shipped = folder.resolve() == CHECKOUT and entry.name not in ("runs", "data")
            can_enter = mode & (stat.S_IXGRP | stat.S_IXOTH)
            if level < _LEVELS and can_enter and not entry.name.startswith(".") and not is_shipped:
                yield from _open_below(Path(entry.path), level + 1)
        elif stat.S_ISREG(mode) and mode & (stat.S_IRWXG | stat.S_IRWXO) and entry.name.endswith(_KINDS):
            yield Path(entry.path)


def check_node(name: str, entry: NodeEntry) -> Iterator[Risk]:
    """List what a node of a launch file opens to others or loads from elsewhere."""
    check = f"node {name}"
    risks = [*_check_module(check, entry), *_check_environment(check, entry)]
    is_link = entry.module == LINK_MODULE
    risks += _check_link(check, entry) if is_link else _check_addresses(check, entry.params)
    yield from risks or [Risk(check, Grade.OK, f"{entry.module}: nothing beyond this machine")]


def check_graph(folder: Path) -> Iterator[Risk]:
    """List what the processes of the running graph listen to."""
    import psutil

    from nodes.process.supervisor import read_lock

    owner = read_lock(folder).get("pid")
    if owner is None:
        yield Risk("graph", Grade.OK, "none runs in this domain")
        return
    try:
        supervisor = psutil.Process(owner)
        processes = [supervisor, *supervisor.children(recursive=True)]
    except psutil.NoSuchProcess:
        return
    listeners = [risk for process in processes for risk in check_listeners(process)]
    yield from listeners or [
        Risk("graph", Grade.OK, f"{counted(len(processes), 'process')}, none listens on the network")
    ]


def check_listeners(process: psutil.Process) -> Iterator[Risk]:
    """Each TCP port that a process waits on; others than this machine's own must be links with keys."""
    import psutil

    try:
        words = process.cmdline()
        opened = [
            connection.laddr for connection in process.net_connections("tcp") if connection.status == psutil.CONN_LISTEN
        ]
    except psutil.NoSuchProcess:
        return
    except psutil.AccessDenied:
        mend = "run the check as the graph's user"
        yield Risk("listener", Grade.WARNING, f"process {process.pid} does not let us look", mend)
        return
    who = _option(words, "--name") or f"process {process.pid}"
    for address in opened:
        listener = f"{who} listens on {address.ip} port {address.port}"
        if ipaddress.ip_address(address.ip.partition("%")[0]).is_loopback:
            yield Risk("listener", Grade.OK, f"{listener}, this machine only")
        elif _is_link_with_keys(words):
            yield Risk("listener", Grade.OK, f"{listener}, a link that asks for keys")
        else:
            mend = "bind it to 127.0.0.1, or carry its topics over contrib.two_machines.link with keys"
            yield Risk("listener", Grade.PROBLEM, f"{listener}, without keys", mend)


# run directory


def _parents(folder: Path) -> Iterator[Path]:
    """Directories over one, from below, up to where nobody else may rename what is ours; above is the system's."""
    for parent in folder.absolute().parents:
        if parent.exists():
            yield parent
            if parent.stat().st_mode & stat.S_ISVTX:
                return


def _check_parent(folder: Path, is_next: bool) -> Risk | None:
    """A directory over the meeting place: who may write to it may replace what is below."""
    facts = folder.stat()
    mode, sticky = stat.S_IMODE(facts.st_mode), bool(facts.st_mode & stat.S_ISVTX)
    mend = "export MIRRORWAVE_RUN_DIR=<a directory of your own>"
    # whoever owns the root owns everything; in a namespace of users that need not be user 0
    if facts.st_uid not in (0, os.geteuid(), Path("/").stat().st_uid):
        return Risk("run directory", Grade.PROBLEM, f"{folder} belongs to user {facts.st_uid}", mend)
    if mode & 0o002 and not sticky:
        return Risk(
            "run directory", Grade.PROBLEM, f"all may write to {folder}, mode {mode:04o}", f"chmod o-w {folder}"
        )
    if mode & 0o020 and not sticky:
        # no graph starts in one that is open to a group; what is above it is not looked at
        grade = Grade.PROBLEM if is_next else Grade.WARNING
        return Risk("run directory", grade, f"a group may write to {folder}", f"chmod g-w {folder}")
    return None


def _check_entries(folder: Path) -> Iterator[Risk]:
    for entry in sorted(folder.iterdir()):
        try:
            facts = entry.lstat()
        except FileNotFoundError:
            continue
        if facts.st_uid != os.geteuid():
            yield Risk("run directory", Grade.PROBLEM, f"{entry} belongs to user {facts.st_uid}", f"rm {entry}")
        elif stat.S_ISLNK(facts.st_mode):
            yield Risk("run directory", Grade.PROBLEM, f"{entry} leads elsewhere", f"rm {entry}")
        elif facts.st_mode & 0o022:
            detail = f"others may write to {entry} where they get into its directory"
            yield Risk("run directory", Grade.WARNING, detail, f"chmod go-w {entry}")


# keys


def _check_own(path: Path) -> Risk:
    from contrib.two_machines.keys import load_own

    return _checked("secret key", path, lambda: f"{path}: readable by its owner alone" if load_own(path) else "")


def _check_public(path: Path) -> Risk:
    from contrib.two_machines.keys import load_public

    return _checked("peer's key", path, lambda: f"{path}: {load_public(path).decode()}")


def _check_allowed(folder: Path) -> Risk:
    from contrib.two_machines.keys import load_allowed

    return _checked("allowed keys", folder, lambda: f"{folder}: {', '.join(sorted(load_allowed(folder).values()))}")


def _checked(check: str, path: Path, load: Callable[[], str]) -> Risk:
    """The text of what was loaded, or the rule that was broken; its error says behind a semicolon what mends it."""
    try:
        return Risk(check, Grade.OK, load())
    except ValueError as error:
        detail, _, mend = str(error).partition("; ")
        return Risk(check, Grade.PROBLEM, detail, f"{mend} {path}" if mend.startswith("chmod") else mend)
    except OSError as error:
        return Risk(check, Grade.PROBLEM, f"{path}: {error.strerror}", "mirrorwave security keygen NAME")


# launch file


def _check_module(check: str, entry: NodeEntry) -> Iterator[Risk]:
    if not entry.module.startswith(("nodes.", "contrib.")):
        mend = "start it only if you trust who wrote it"
        yield Risk(check, Grade.WARNING, f"runs {entry.module}, which is no part of mirrorwave", mend)


def _check_environment(check: str, entry: NodeEntry) -> Iterator[Risk]:
    for name in entry.env:
        if name.startswith(_LOADS_CODE) and name not in _HARMLESS:
            yield Risk(
                check, Grade.WARNING, f"env.{name} can load code from elsewhere", "take it out unless you need it"
            )
        elif name in _MOVES_GRAPH:
            yield Risk(check, Grade.WARNING, f"env.{name} moves the graph's meeting place", "take it out")


def _check_addresses(check: str, params: Any) -> Iterator[Risk]:
    """Addresses of the network among the parameters of a node that is no link."""
    from contrib.two_machines.keys import is_loopback

    for text in _texts(params):
        if text.startswith("tcp://") and not is_loopback(text):
            mend = f"carry its topics over {LINK_MODULE} with keys"
            yield Risk(check, Grade.PROBLEM, f"{text} leaves this machine without keys", mend)
        elif text in _CAN_OVER_NETWORK:
            mend = "keep it to a network of its own, or use socketcan"
            yield Risk(check, Grade.WARNING, f"{text}: who is on this network can send and read CAN frames", mend)


def _check_link(check: str, entry: NodeEntry) -> list[Risk]:
    """A link: whom it lets in, whom it asks, and the keys for both."""
    from contrib.two_machines.keys import is_loopback
    from contrib.two_machines.link import Params
    from nodes.process.validation import convert_at

    try:
        params = convert_at(entry.params, Params, f"{check}: params")
    except ValueError as error:
        mend = "set key, allowed and connect.PEER.key; mirrorwave security keygen NAME makes keys"
        return [Risk(check, Grade.PROBLEM, f"will not start: {error}", mend)]
    mend = "give it keys: mirrorwave security keygen NAME"
    opened = params.open_addresses()
    risks = [Risk(check, Grade.PROBLEM, f"{address} is open without keys", mend) for address in opened]
    plain = [peer.address for peer in params.connect.values() if not peer.key] + [params.bind] * (not params.key)
    risks += [
        Risk(check, Grade.WARNING, f"{address} is open to all users of this machine", mend)
        for address in plain
        if is_loopback(address)
    ]
    if params.insecure and not opened:
        risks.append(Risk(check, Grade.WARNING, "insecure: true is set and not needed", "take it out"))
    risks += [_check_own(Path(params.key))] if params.key else []
    risks += [_check_allowed(Path(params.allowed))] if params.allowed else []
    risks += [_check_public(Path(peer.key)) for peer in params.connect.values() if peer.key]
    if any(risk.status is Grade.PROBLEM for risk in risks):
        return risks
    taken = "; ".join(f"takes {', '.join(peer.topics)} from {name}" for name, peer in params.connect.items())
    exported = f"gives {', '.join(params.export)} to peers" if params.export else ""
    return [*risks, Risk(check, Grade.OK, "; ".join(filter(None, (exported, taken))))]


# running graph


def _is_link_with_keys(words: list[str]) -> bool:
    """Return whether a command line is that of a link that admits only the keys on its list."""
    from contrib.two_machines.link import Params

    text = _option(words, "--params")
    if LINK_MODULE not in words or text is None:
        return False
    try:
        params = msgspec.json.decode(text, type=Params)
    except (msgspec.MsgspecError, ValueError):
        return False
    return bool(params.key and params.allowed)


def _option(words: list[str], name: str) -> str | None:
    at = words.index(name) + 1 if name in words else len(words)
    return words[at] if at < len(words) else None


def _texts(value: Any) -> Iterator[str]:
    """All texts in plain data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _texts(inner)
