"""Node `link`: carries selected topics to and from other hosts, each with a graph of its own.

It alone opens TCP beyond this machine, one port for exports, and encrypts all traffic (`contrib.two_machines.curve`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

import msgspec
import zmq

from contrib.two_machines.exporter import Exporter
from contrib.two_machines.importer import Importer, Server
from contrib.two_machines.keys import KeyPair, allowed_signature, is_loopback, load_allowed, load_own, load_public
from msgs.bus.interface import Forwarded, Received
from msgs.bus.sequencing import MAX_LATCHED
from msgs.bus.topics import topic_facts
from msgs.bus.zmq import InterruptibleContext
from msgs.values.diagnostics import NodeState
from msgs.values.units import NANOSECONDS_PER_SECOND
from nodes.node import NODE_NAME, Node

_LOG = logging.getLogger(__name__)

#: A key that is added to the folder of allowed keys, or removed from it, takes effect so soon.
LOOK_NS = NANOSECONDS_PER_SECOND


class Peer(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A host whose topics are imported."""

    #: tcp://HOST:PORT, the `bind` of its link.
    address: str
    #: File of its public key.
    key: str = ""
    topics: tuple[str, ...]

    def __post_init__(self) -> None:
        _require_tcp(self.address)
        _require_topics(self.topics)


class Params(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Topics to and from peers; paths are relative to the folder where the graph is launched."""

    formerly: ClassVar[dict[str, str]] = {"name": "contrib.two_machines.link"}

    #: File of this host's secret key (`mirrorwave security keygen`).
    key: str = ""
    #: Folder of the public keys of the peers that may connect.
    allowed: str = ""
    #: Address for peers to connect to, e.g. tcp://*:7100; none: nothing is exported.
    bind: str = ""
    #: Topics that peers may receive.
    export: tuple[str, ...] = ()
    #: Peers by the prefix of their nodes' names.
    connect: dict[str, Peer] = {}
    #: Open TCP beyond this machine without keys, to every host that can reach it.
    insecure: bool = False

    def __post_init__(self) -> None:
        if bool(self.bind) != bool(self.export):
            raise ValueError("bind and export belong together: where peers connect, and what they may have")
        if not (self.bind or self.connect):
            raise ValueError("a link needs bind and export, or connect, or both")
        if self.bind:
            _require_tcp(self.bind)
        _require_topics(self.export)
        for name, peer in self.connect.items():
            if not NODE_NAME.fullmatch(name):
                raise ValueError(f"connect.{name}: a peer's name must be of a-z, 0-9 and _")
            if peer.key and not self.key:
                raise ValueError(f"connect.{name}: its key needs an own one, key")
        if bool(self.allowed) != bool(self.key and self.bind):
            raise ValueError("key, allowed and bind belong together: who we are, who may connect, and where")
        for address in () if self.insecure else self.open_addresses():
            raise ValueError(f"{address}: TCP beyond this machine needs keys (key and allowed, connect.PEER.key)")

    def open_addresses(self) -> list[str]:
        """Return addresses beyond this machine that no key protects."""
        plain = [peer.address for peer in self.connect.values() if not peer.key]
        if self.bind and not self.key:
            plain.append(self.bind)
        return [address for address in plain if not is_loopback(address)]

    def selected_topics(self) -> tuple[str, ...]:
        """Return the topics of this graph that it reads."""
        return self.export

    def imported_topics(self) -> tuple[str, ...]:
        """Return the topics of peers that it publishes here."""
        return tuple(sorted({topic for peer in self.connect.values() for topic in peer.topics}))

    @property
    def own_name(self) -> str:
        """Name of this host."""
        return Path(self.key).stem if self.key else "this host"


class Link(Node):
    """Local topics -> peers, and peers' topics -> local graph; imported messages are never exported again."""

    #: A peer counts omitted messages as lost.
    wants_all = True
    takes_all_publishers = True
    max_origins = MAX_LATCHED

    def __init__(self, params: Params) -> None:
        super().__init__()
        own, public = _keys(params)
        allowed = load_allowed(Path(params.allowed)) if params.allowed else {}
        self._allowed = AllowedFolder(Path(params.allowed)) if params.allowed else None
        self._look_ns: int | None = None
        self._context = InterruptibleContext()
        self._exporter: Exporter | None = None
        self._importers: list[Importer] = []
        self._reported: dict[tuple[str, str], int] = {}
        self._open = params.open_addresses()
        try:
            self._connect(params, own, public)
            if params.bind:
                self._exporter = Exporter(self._context, params.bind, params.export, own if allowed else None, allowed)
        except BaseException:
            self.close()
            raise
        self.inputs, self.outputs = params.selected_topics(), params.imported_topics()
        self._say(params, allowed.values())

    @property
    def address(self) -> str:
        """The bound address for peers; empty if nothing is exported."""
        return self._exporter.address if self._exporter else ""

    def watched(self) -> tuple[zmq.Socket[bytes], ...]:
        """Return the sockets of all peers."""
        ends = [importer.sources for importer in self._importers]
        if self._exporter is not None:
            ends.append(self._exporter.sources)
        return tuple(source for sources in ends for source in sources)

    def pending(self) -> bool:
        """Return whether a peer has sent a message."""
        return any(source.poll(0) for source in self.watched())

    def due_ns(self, now_ns: int) -> int | None:
        """Return when a peer is to be asked for its clock, or the folder of allowed keys to be looked at."""
        due_ns = [importer.due_ns for importer in self._importers]
        if self._allowed is not None:
            due_ns.append(now_ns if self._look_ns is None else self._look_ns)
        return min(due_ns, default=None)

    def step(self, inputs: list[Received], now_ns: int) -> list[Forwarded]:
        """Send this graph's messages to peers, return the peers' messages."""
        if self._exporter is not None:
            self._look_at_keys(self._exporter, now_ns)
            for received in inputs:
                self._exporter.send(received)
            self._exporter.turn()
        imported = [message for importer in self._importers for message in importer.turn()]
        self._count()
        return imported

    def health(self) -> tuple[NodeState, str]:
        """Return DEGRADED while a peer is silent, no thread judges connections, or no key protects an address."""
        troubles = [trouble for importer in self._importers if (trouble := importer.trouble())]
        if self._exporter is not None and not self._exporter.alive:
            troubles.append("nobody is let in: the authenticator has ended")
        if self._allowed is not None and self._allowed.trouble:
            troubles.append(f"the list of peers is that of before: {self._allowed.trouble}")
        troubles += [f"{address} is open without keys" for address in self._open]
        return (NodeState.DEGRADED, "; ".join(troubles)) if troubles else (NodeState.READY, "")

    def close(self) -> None:
        """Disconnect from all peers and close the port."""
        for importer in self._importers:
            importer.close()
        if self._exporter is not None:
            self._exporter.close()
        self._context.destroy()

    def _connect(self, params: Params, own: KeyPair | None, public: dict[str, bytes]) -> None:
        for name, peer in params.connect.items():
            server = Server(name, peer.address, public.get(name))
            self._importers.append(Importer(self._context, server, peer.topics, own if name in public else None))

    def _look_at_keys(self, exporter: Exporter, now_ns: int) -> None:
        if self._allowed is None or (self._look_ns is not None and now_ns < self._look_ns):
            return
        self._look_ns = now_ns + LOOK_NS
        changed = self._allowed.changed()
        if changed is not None:
            exporter.allow(changed)
            _LOG.info("%s is open to %s", exporter.address, ", ".join(changed.values()) or "nobody")

    def _say(self, params: Params, allowed: Iterable[str]) -> None:
        if self.address:
            _LOG.info("%s: %s is open to %s", params.own_name, self.address, ", ".join(allowed) or "all")
        for address in self._open:
            _LOG.warning("INSECURE: %s has no keys: whoever reaches it reads along or speaks to this graph", address)

    def _count(self) -> None:
        """Report losses and refusals so far in the heartbeat, and the round trips beside the stages."""
        if self._exporter is not None:
            self._shed("handshake", "refused", self._exporter.refused)
            self._shed("message", "rejected", self._exporter.rejected)
            for topic, superseded in self._exporter.superseded().items():
                self._shed(f"{topic} message", "replaced by a newer one", superseded)
        for importer in self._importers:
            self._shed(f"{importer.name} handshake", "failed", importer.refused)
            self._shed(f"{importer.name} message", "rejected", importer.rejected)
            for topic, lost in importer.lost().items():
                self._shed(f"{importer.name} {topic} message", "lost on the link", lost)
            for round_trip_ns in importer.round_trips_ns():
                self.stages.add(f"{importer.name} round trip", round_trip_ns)

    def _shed(self, kind: str, reason: str, total: int) -> None:
        if more := total - self._reported.get((kind, reason), 0):
            self._reported[kind, reason] = total
            self.shed.add(kind, reason, more)


class AllowedFolder:
    """Watch of a folder of allowed keys. While it cannot be read as a list the one of before stays, and `trouble` says
    why.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._signature = allowed_signature(folder)
        self.trouble = ""

    def changed(self) -> dict[bytes, str] | None:
        """Return the new list if the folder has changed to another one, empty if it holds no key any more."""
        try:
            signature = allowed_signature(self._folder)
            if signature == self._signature:
                return None
            self._signature = signature
            allowed = load_allowed(self._folder, may_be_empty=True)
        except (ValueError, OSError) as error:
            if (trouble := str(error)) != self.trouble:
                _LOG.error("the list of peers is that of before: %s", trouble)
            self.trouble = trouble
            return None
        self.trouble = ""
        return allowed


def create(params: Params) -> Link:
    """Return the node, its port open; raises `ValueError` or `OSError` naming key, folder or address."""
    return Link(params)


def _keys(params: Params) -> tuple[KeyPair | None, dict[str, bytes]]:
    """Return the own key pair and the public keys of the peers that have one."""
    own = load_own(Path(params.key)) if params.key else None
    return own, {name: load_public(Path(peer.key)) for name, peer in params.connect.items() if peer.key}


def _require_tcp(address: str) -> None:
    if not address.startswith("tcp://"):
        raise ValueError(f"an address must be tcp://HOST:PORT, got {address!r}")


def _require_topics(topics: Iterable[str]) -> None:
    for topic in topics:
        topic_facts(topic)
