"""One ROS 2 node on DDS: its participant, its endpoints, and what it tells the graph about itself.

By default the node is reachable from this computer only, as with ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST``.  The
configuration is given here whole: ``CYCLONEDDS_URI`` of the environment has no effect, so that no variable opens the
node to a network.
"""

from __future__ import annotations

from typing import Final, TypeVar

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from ros2.interfaces.graph import Gid, NodeEntitiesInfo, ParticipantEntitiesInfo
from ros2.wire.qos import endpoint_qos, latched
from runtime.errors import LinkError

LOOPBACK: Final = "127.0.0.1"
MAX_DOMAIN: Final = 232
"""Greatest domain whose ports exist (DDSI-RTPS 9.6.1.1)."""
_LOCAL_DISCOVERY: Final = '<Peers><Peer address="localhost"/></Peers>'

Message = TypeVar("Message", bound=IdlStruct)


class Node:
    """A node ``name`` in the root namespace of a domain (``ROS_DOMAIN_ID``)."""

    def __init__(self, name: str, domain_id: int, interface: str = LOOPBACK) -> None:
        """Open a node; ``interface`` is the address of the network interface to use.

        Raises:
            LinkError: the domain cannot be opened there.
        """
        self._name = name
        try:
            self._domain = Domain(domain_id, _configuration(interface))
            self.participant = DomainParticipant(domain_id, qos=Qos(Policy.Userdata(b"enclave=/;")))
        except DDSException as error:
            raise LinkError(
                "ros2.no-domain",
                f"ROS 2 domain {domain_id} cannot be opened on {interface}: {error.msg}; "
                "give the address of an interface that is up",
            ) from None
        self._readers: list[Gid] = []
        self._writers: list[Gid] = []
        self._graph = self._writer("ros_discovery_info", ParticipantEntitiesInfo, latched(1))

    def publisher(self, topic: str, message: type[Message], profile: Qos) -> DataWriter[Message]:
        """Make a writer of the topic ``/topic``."""
        return self.writer(f"rt/{topic}", message, profile)

    def writer(self, name: str, message: type[Message], profile: Qos, identity: str = "") -> DataWriter[Message]:
        """Make a writer by the topic's name on the wire."""
        made = self._writer(name, message, profile, identity)
        self._writers.append(Gid(made.get_guid().bytes))
        return made

    def reader(self, name: str, message: type[Message], profile: Qos, identity: str = "") -> DataReader[Message]:
        """Make a reader by the topic's name on the wire."""
        topic = Topic(self.participant, name, message)
        made = DataReader(self.participant, topic, qos=endpoint_qos(message, profile, identity))
        self._readers.append(Gid(made.get_guid().bytes))
        return made

    def announce(self) -> None:
        """Tell the graph about this node and its endpoints, after the last of them was made."""
        node = NodeEntitiesInfo("/", self._name, self._readers, self._writers)
        self._graph.write(ParticipantEntitiesInfo(Gid(self.participant.get_guid().bytes), [node]))

    def _writer(self, name: str, message: type[Message], profile: Qos, identity: str = "") -> DataWriter[Message]:
        topic = Topic(self.participant, name, message)
        return DataWriter(self.participant, topic, qos=endpoint_qos(message, profile, identity))


def send(writer: DataWriter[Message], message: Message) -> bool:
    """Send; False when a reader is too slow to take it."""
    try:
        writer.write(message)
    except DDSException as error:
        if error.code != DDSException.DDS_RETCODE_TIMEOUT:
            raise
        return False
    return True


def _configuration(interface: str) -> str:
    """Write Cyclone's configuration: one interface; on loopback no multicast, this computer as the only peer."""
    local = interface == LOOPBACK
    multicast = "<AllowMulticast>false</AllowMulticast>" if local else ""
    return (
        '<CycloneDDS><Domain id="any"><General><Interfaces>'
        f'<NetworkInterface address="{interface}"/></Interfaces>{multicast}</General>'
        "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
        f"{_LOCAL_DISCOVERY if local else ''}</Discovery></Domain></CycloneDDS>"
    )
