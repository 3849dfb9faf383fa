"""``builtin_interfaces``, ``std_msgs``, ``unique_identifier_msgs`` and ``geometry_msgs``."""

from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32

NS_PER_S = 1_000_000_000


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """Time since the Unix epoch."""

    sec: int32
    nanosec: uint32


@dataclass
class Duration(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    """A span of time; ``nanosec`` counts forward also for a negative one."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Stamp and coordinate frame of a message."""

    stamp: Time
    frame_id: str


@dataclass
class UUID(IdlStruct, typename="unique_identifier_msgs::msg::dds_::UUID_"):
    """An identifier of 16 bytes."""

    uuid: array[uint8, 16]


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """A vector."""

    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """A rotation, scalar last."""

    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    """Where a child frame lies in its parent, m."""

    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    """A transform from ``header.frame_id`` to ``child_frame_id``."""

    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    """A velocity, m/s and rad/s."""

    linear: Vector3
    angular: Vector3


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    """Transforms."""

    transforms: sequence[TransformStamped]


def time_of(ns: int) -> Time:
    """Make the message of a time in ns."""
    return Time(ns // NS_PER_S, ns % NS_PER_S)


def duration_of(ns: int) -> Duration:
    """Make the message of a duration in ns."""
    return Duration(ns // NS_PER_S, ns % NS_PER_S)


def nanoseconds(message: Time | Duration) -> int:
    """Return the ns of a time or a duration."""
    return message.sec * NS_PER_S + message.nanosec
