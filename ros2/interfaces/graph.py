"""``rmw_dds_common``: how a process tells which nodes it has, and which readers and writers belong to each."""

from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, sequence, uint8


@dataclass
class Gid(IdlStruct, typename="rmw_dds_common::msg::dds_::Gid_"):
    """The DDS GUID of an entity (16 bytes since Iron; Humble has 24)."""

    data: array[uint8, 16]


@dataclass
class NodeEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::NodeEntitiesInfo_"):
    """A node and its endpoints."""

    node_namespace: str
    node_name: str
    reader_gid_seq: sequence[Gid]
    writer_gid_seq: sequence[Gid]


@dataclass
class ParticipantEntitiesInfo(IdlStruct, typename="rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_"):
    """The nodes of a participant."""

    gid: Gid
    node_entities_info_seq: sequence[NodeEntitiesInfo]
