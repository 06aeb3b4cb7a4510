"""The bridge's end of ROS 2: a DDS participant whose topics, types and quality of service nodes of ROS 2 recognise.

Messages are serialised by rosbags, which is fast with arrays; cyclonedds carries the bytes. The types that it announces
are built from the definitions that rosbags has.
"""

from __future__ import annotations

import contextlib
import os
from typing import Any
from xml.sax.saxutils import quoteattr

import psutil

from contrib.ros2.ros2_topics import INPUT_DEPTH, Ros2Topic

LOOPBACK = "lo"
MAX_DOMAIN = 232
#: Larger messages are dropped before they are put together.
MAX_INPUT_BYTES = 16 << 20
#: Participants of one machine that are looked for where there is no multicast.
MAX_PARTICIPANTS = 32
#: A reader that takes nothing holds the bridge up for so long at most, message by message.
MAX_BLOCKING_NS = 10_000_000
#: Unacknowledged bytes of a topic before the bridge waits for its readers.
MAX_WAITING = "16 MiB"
#: Policies by their numbers in DDS.
POLICIES = {2: "durability", 4: "deadline", 5: "latency budget", 6: "ownership", 8: "liveliness", 11: "reliability",
            12: "destination order", 23: "data representation", 24: "type consistency"}  # fmt: skip
#: Fast DDS: types are matched by name, because Cyclone DDS 11 rejects the type objects that it sends.
_FAST_DDS = "1.15"
#: Nodes are looked for at the ports of this machine, once a second and for ever: ROS 2 may announce itself by multicast
#: alone, which is not heard here.
_LOCAL_DISCOVERY = (
    "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
    f"<MaxAutoParticipantIndex>{MAX_PARTICIPANTS}</MaxAutoParticipantIndex>"
    "<SPDPInterval>1s</SPDPInterval><InitialLocatorPruneDelay>inf</InitialLocatorPruneDelay>"
    '<Peers><Peer Address="127.0.0.1"/></Peers></Discovery>'
)


def require_library() -> None:
    """Raise `ValueError` that names the extra where a library is missing."""
    for name in ("cyclonedds", "rosbags"):
        try:
            __import__(name)
        except ImportError:
            raise ValueError(
                f"the bridge needs {name}, which is not installed: pip install 'mirrorwave[ros2]'"
            ) from None


def require_interface(name: str) -> None:
    """Raise `ValueError` unless this machine has the network interface."""
    known = sorted(psutil.net_if_addrs())
    if name not in known:
        raise ValueError(f"interface must be one of {', '.join(known)}, got {name!r}")


def domain_config(interface: str) -> str:
    """Return the configuration of Cyclone DDS for one interface alone; the loopback has no multicast."""
    is_local = interface == LOOPBACK
    parts = (
        "<General>",
        f"<Interfaces><NetworkInterface name={quoteattr(interface)}/></Interfaces>",
        "<AllowMulticast>false</AllowMulticast>" if is_local else "",
        "<MaxMessageSize>65500B</MaxMessageSize></General>",
        _LOCAL_DISCOVERY if is_local else "",
        f"<Compatibility><IgnoreTypeInformation>{_FAST_DDS}</IgnoreTypeInformation></Compatibility>",
        f"<Internal><Watermarks><WhcHigh>{MAX_WAITING}</WhcHigh></Watermarks>",
        # of a cloud in hundreds of pieces most would be lost; the kernel's limit, net.core.rmem_max, holds
        f'<SocketReceiveBufferSize max="{MAX_INPUT_BYTES}B"/>',
        f"<MaxSampleSize>{MAX_INPUT_BYTES}B</MaxSampleSize></Internal>",
    )
    return f'<CycloneDDS><Domain Id="any">{"".join(parts)}</Domain></CycloneDDS>'


class Writer:
    """Publishes serialised messages on one topic."""

    def __init__(self, entity: Any, data_type: type, topic: Ros2Topic) -> None:
        self._entity, self._data_type, self.topic = entity, data_type, topic
        self._mismatches = 0

    @property
    def is_wanted(self) -> bool:
        """Whether a message has a reader, now or later."""
        return self.topic.latched or bool(self._entity.get_publication_matched_status().current_count)

    def write(self, cdr: bytes) -> bool:
        """Send a message; false where its readers take nothing."""
        from cyclonedds.core import DDSException

        sample: Any = object.__new__(self._data_type)
        sample.cdr = cdr
        try:
            self._entity.write(sample)
        except DDSException as error:
            if error.code == DDSException.DDS_RETCODE_TIMEOUT:
                return False
            raise
        return True

    def mismatch(self) -> str:
        """Return the policy that kept a reader away since the last call; empty where none did."""
        status = self._entity.get_offered_incompatible_qos_status()
        before, self._mismatches = self._mismatches, status.total_count
        return "" if status.total_count == before else POLICIES.get(status.last_policy_id, str(status.last_policy_id))


class Reader:
    """Receives serialised messages of one topic; the link's descriptor says when there are any."""

    def __init__(self, entity: Any, name: str) -> None:
        self._entity, self.name = entity, name
        self._mismatches = 0

    def take(self) -> list[bytes]:
        """Return the messages that wait, oldest first."""
        samples = self._entity.take(N=INPUT_DEPTH)
        return [sample.cdr for sample in samples if hasattr(sample, "cdr")]

    def mismatch(self) -> str:
        """Return the policy that kept a publisher away since the last call; empty where none did."""
        status = self._entity.get_requested_incompatible_qos_status()
        before, self._mismatches = self._mismatches, status.total_count
        return "" if status.total_count == before else POLICIES.get(status.last_policy_id, str(status.last_policy_id))


class Ros2Link:
    """A participant of one domain on one interface, and its topics."""

    def __init__(self, domain: int, interface: str, store: Any) -> None:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant

        try:
            self._domain: Any = Domain(domain, domain_config(interface))
            self._participant: Any = DomainParticipant(domain)
        except DDSException:
            raise OSError(f"domain {domain} cannot be joined on {interface}: is it up, with an address?") from None
        self._store = store
        self._types: dict[str, Any] = {}
        self._entities: list[Any] = []
        #: Can be read once a message has arrived.
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def writer(self, topic: Ros2Topic) -> Writer:
        """Announce a topic."""
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        data_type = self._topic_type(topic.kind)
        dds_topic = Topic(self._participant, f"rt/{topic.name}", data_type)
        entity = DataWriter(self._participant, dds_topic, qos=self._quality(topic))
        self._entities += [entity, dds_topic]
        return Writer(entity, data_type, topic)

    def reader(self, topic: Ros2Topic) -> Reader:
        """Subscribe to a topic."""
        from cyclonedds.core import Listener
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        dds_topic = Topic(self._participant, f"rt/{topic.name}", self._topic_type(topic.kind))
        listener = Listener(on_data_available=lambda _reader: os.eventfd_write(self.descriptor, 1))
        entity = DataReader(self._participant, dds_topic, qos=self._quality(topic), listener=listener)
        self._entities += [entity, dds_topic]
        return Reader(entity, topic.name)

    def clear(self) -> None:
        """Note that all that has arrived is being taken."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self.descriptor)

    def close(self) -> None:
        """Leave the domain."""
        # entities of cyclonedds end with their last reference, and a participant must outlast what it holds
        for entity in [*self._entities, self._participant, self._domain]:
            entity._delete(entity._ref)
            entity._entities.pop(entity._ref, None)
        self._entities.clear()
        os.close(self.descriptor)

    def _quality(self, topic: Ros2Topic) -> Any:
        from cyclonedds.core import Policy, Qos

        reliability = Policy.Reliability
        durability = Policy.Durability
        return Qos(
            reliability.Reliable(MAX_BLOCKING_NS) if topic.reliable else reliability.BestEffort,
            durability.TransientLocal if topic.latched else durability.Volatile,
            Policy.History.KeepLast(topic.depth),
            Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
            # how ROS 2 tells that both sides mean the same fields
            Policy.Userdata(f"typehash={self._store.hash_rihs01(topic.kind)};".encode()),
        )

    def _topic_type(self, kind: str) -> Any:
        """Return a type of cyclonedds whose objects are nothing but their bytes."""
        data_type = self._struct(kind)
        if not hasattr(data_type, "cdr"):
            data_type.cdr = b""
            data_type.serialize = lambda sample, *_args, **_options: sample.cdr
            data_type.deserialize = data_type.deserialize_key = classmethod(_of_bytes)
        return data_type

    def _struct(self, kind: str) -> Any:
        """Return a type's definition for cyclonedds, under the name that ROS 2 gives it in DDS."""
        from cyclonedds.idl import make_idl_struct

        if kind not in self._types:
            package, _, name = kind.split("/")
            fields = {field: self._field(node) for field, node in self._store.fielddefs[kind][1]}
            self._types[kind] = make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields)
        return self._types[kind]

    def _field(self, node: Any) -> Any:
        from cyclonedds.idl import types
        from rosbags.interfaces import Nodetype

        kind, detail = node
        if kind == Nodetype.NAME:
            return self._struct(detail)
        if kind == Nodetype.ARRAY:
            return types.array[self._field(detail[0]), detail[1]]
        if kind == Nodetype.SEQUENCE:
            return types.sequence[self._field(detail[0])]
        plain = {"bool": bool, "string": str, "byte": types.uint8, "octet": types.uint8, "char": types.uint8}
        return plain.get(detail[0]) or getattr(types, detail[0])


def _of_bytes(data_type: type, cdr: bytes, **_options: Any) -> Any:
    sample: Any = object.__new__(data_type)
    sample.cdr = bytes(cdr)
    return sample
