"""Check for a running graph in a domain, and the one line where none runs: what is missing and what starts it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nodes.process.launch_file import LaunchFile

#: A graph that is being started has its first socket well within this.
FIND_S = 5.0
_LOOK_S = 0.1


def is_running(domain: str) -> bool:
    """Return whether anybody publishes in a domain: nodes of ours, or other programs."""
    return bool(_publishers(domain))


def publishes(domain: str, topic: str) -> bool:
    """Return whether anybody publishes a topic in a domain."""
    return topic.replace("/", ".") in _publishers(domain)


def require_graph(domain: str) -> None:
    """Wait for the first publisher of a domain; raises `ConnectionError` where none comes within `FIND_S`."""
    end_s = time.monotonic() + FIND_S
    while not is_running(domain):
        if time.monotonic() >= end_s:
            raise no_graph(domain)
        time.sleep(_LOOK_S)


def know_topics(domain: str) -> None:
    """Make the topics known that the graph of a domain declares beside those of all graphs."""
    from msgs.bus.declared import expect_declared
    from msgs.bus.zmq import run_dir

    expect_declared(run_dir(domain))


def launch_of_graph(run_dir: Path) -> LaunchFile | None:
    """Return the launch file of the graph that runs in a directory, as it was resolved; None where none is read."""
    from nodes.process.launch_file import read_launch_file
    from nodes.process.supervisor import read_lock

    try:
        return read_launch_file(Path(read_lock(run_dir)["run"]) / "launch.yaml")
    except (KeyError, OSError, ValueError):
        return None


def no_graph(domain: str) -> ConnectionError:
    """The error for a domain in which no graph runs: what starts one, and the domains in which one does."""
    running = [name for name in _domains() if name != domain and is_running(name)]
    elsewhere = f"; one runs in --domain {' and '.join(running)}" if running else ""
    return ConnectionError(
        f"no graph runs in domain {domain!r}: start one with `mirrorwave launch FILE` or `mirrorwave demo`{elsewhere}"
    )


def no_heartbeat(domain: str, window_s: float) -> ConnectionError:
    """The error for a domain that gave no heartbeat: without a graph, or with one whose nodes do not answer."""
    if not is_running(domain):
        return no_graph(domain)
    return ConnectionError(
        f"no node of domain {domain!r} gave a heartbeat in {window_s:g} s; `mirrorwave doctor` says why"
    )


def silence(domain: str, topics: Iterable[str], window_s: float) -> OSError:
    """The error for topics on which nothing came: without a graph, without a publisher, or from a silent one."""
    if not is_running(domain):
        return no_graph(domain)
    silent = list(topics)
    unpublished = [topic for topic in silent if not publishes(domain, topic)]
    nobody = f"; nobody publishes {', '.join(unpublished)}" if unpublished else ""
    return TimeoutError(f"nothing came on {', '.join(silent)} in {window_s:g} s{nobody}")


def _publishers(domain: str) -> set[str]:
    """Topics that are published in a domain, each as its socket file names it."""
    from mirrorwave.diagnose.foreign_topic import foreign_publishers
    from msgs.bus.zmq import list_publishers, run_dir

    ours = {topic.replace("/", ".") for topic, _ in list_publishers(run_dir(domain))}
    return ours | set(foreign_publishers(run_dir(domain)))


def _domains() -> list[str]:
    """Domains that have a directory beside the default one's."""
    from mirrorwave.console import DEFAULT_DOMAIN
    from msgs.bus.zmq import run_dir

    domains = []
    with contextlib.suppress(OSError):
        for entry in sorted(run_dir(DEFAULT_DOMAIN).parent.iterdir()):
            # a folder of another name is none
            with contextlib.suppress(ValueError):
                if entry.is_dir() and run_dir(entry.name):
                    domains.append(entry.name)
    return domains
