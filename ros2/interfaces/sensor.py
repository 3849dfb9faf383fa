"""``sensor_msgs``."""

from dataclasses import dataclass
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl._machinery import BytesMachine
from cyclonedds.idl.types import array, float64, sequence, uint8, uint32

from ros2.interfaces.builtin import Header


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """Positions [rad, m] and velocities [per s] of joints by name; ``effort`` is empty: nothing measures it."""

    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class RegionOfInterest(IdlStruct, typename="sensor_msgs::msg::dds_::RegionOfInterest_"):
    """A window of a picture; all 0 is the whole picture."""

    x_offset: uint32
    y_offset: uint32
    height: uint32
    width: uint32
    do_rectify: bool


@dataclass
class CameraInfo(IdlStruct, typename="sensor_msgs::msg::dds_::CameraInfo_"):
    """A camera's calibration; ``k``, ``r`` and ``p`` are row-major."""

    header: Header
    height: uint32
    width: uint32
    distortion_model: str
    d: sequence[float64]
    k: array[float64, 9]
    r: array[float64, 9]
    p: array[float64, 12]
    binning_x: uint32
    binning_y: uint32
    roi: RegionOfInterest


@dataclass
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    """A picture in rows of ``step`` bytes; ``data`` is given as `bytes`."""

    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


def _send_bytes_at_once() -> None:
    """Let Cyclone copy a picture's bytes: it would pack each as a number of its own, 0.3 s for 1280 x 720 pixels."""
    idl: Any = Image.__idl__
    idl.populate()
    for machine in (idl.v1_machine, idl.v2_machine):
        machine.members_machines["data"] = BytesMachine()


_send_bytes_at_once()
