"""The ROS 2 types as their packages publish them, made independently of the bridge's own.

The definitions of the core packages come with ``rosbags``; those of control_msgs (6.8, BSD-3-Clause,
github.com/ros-controls/control_msgs) stand here.  `idl_type` makes a type for Cyclone DDS of a definition.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from types import new_class
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

ACTION = "control_msgs/action/FollowJointTrajectory"
TOLERANCES = {
    "control_msgs/msg/JointTolerance": "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration",
    "control_msgs/msg/JointComponentTolerance": "uint16 X_AXIS=1\nuint16 Y_AXIS=2\nuint16 Z_AXIS=3\n"
    "uint16 TRANSLATION=4\nuint16 ROTATION=5\nstring joint_name\nuint16 component\nfloat64 position\n"
    "float64 velocity\nfloat64 acceleration",
}
GOAL = """trajectory_msgs/JointTrajectory trajectory
trajectory_msgs/MultiDOFJointTrajectory multi_dof_trajectory
control_msgs/JointTolerance[] path_tolerance
control_msgs/JointComponentTolerance[] component_path_tolerance
control_msgs/JointTolerance[] goal_tolerance
control_msgs/JointComponentTolerance[] component_goal_tolerance
builtin_interfaces/Duration goal_time_tolerance"""
RESULT = """int32 error_code
int32 SUCCESSFUL = 0
int32 INVALID_GOAL = -1
int32 INVALID_JOINTS = -2
int32 OLD_HEADER_TIMESTAMP = -3
int32 PATH_TOLERANCE_VIOLATED = -4
int32 GOAL_TOLERANCE_VIOLATED = -5
string error_string"""
FEEDBACK = """std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint desired
trajectory_msgs/JointTrajectoryPoint actual
trajectory_msgs/JointTrajectoryPoint error
int32 index
string[] multi_dof_joint_names
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_desired
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_actual
trajectory_msgs/MultiDOFJointTrajectoryPoint multi_dof_error
int32 multi_dof_index"""
DERIVED = {
    "SendGoal_Request": "unique_identifier_msgs/UUID goal_id\ncontrol_msgs/FollowJointTrajectory_Goal goal",
    "SendGoal_Response": "bool accepted\nbuiltin_interfaces/Time stamp",
    "GetResult_Request": "unique_identifier_msgs/UUID goal_id",
    "GetResult_Response": "int8 status\ncontrol_msgs/FollowJointTrajectory_Result result",
    "FeedbackMessage": "unique_identifier_msgs/UUID goal_id\ncontrol_msgs/FollowJointTrajectory_Feedback feedback",
}
CANCEL = {
    "action_msgs/srv/CancelGoal_Request": "action_msgs/GoalInfo goal_info",
    "action_msgs/srv/CancelGoal_Response": "int8 return_code\naction_msgs/GoalInfo[] goals_canceling",
}


def published(distribution: str = "lyrical") -> Typestore:
    """The types of a distribution; before Kilted the feedback had no index."""
    store = get_typestore(Stores[f"ROS2_{distribution.upper()}"])
    feedback = FEEDBACK if distribution != "jazzy" else re.sub(r"int32 \w+\n|\nint32 \w+$", "", FEEDBACK)
    parts = {"Goal": GOAL, "Result": RESULT, "Feedback": feedback} | DERIVED
    texts = TOLERANCES | CANCEL | {f"{ACTION}_{name}": text for name, text in parts.items()}
    for name, text in texts.items():
        # rosbags knows messages only: an action's name is put in its place afterwards.
        ((_, (constants, fields)),) = get_types_from_msg(text, re.sub("/(srv|action)/", "/msg/", name)).items()
        store.fielddefs[name] = (constants, _renamed(fields))
    return store


def _renamed(part: Any) -> Any:
    if isinstance(part, str):
        return part.replace("control_msgs/msg/Follow", "control_msgs/action/Follow")
    return type(part)(map(_renamed, part)) if type(part) in (list, tuple) else part


NUMBERS = ("uint8", "int8", "uint16", "int32", "uint32", "int64", "uint64", "float64")
PRIMITIVES = {name: getattr(idl, name) for name in NUMBERS} | {"bool": bool, "string": str}
PRIMITIVES |= {"byte": idl.uint8, "char": idl.uint8}


class IdlTypes:
    """Types for Cyclone DDS, made of the published definitions.

    Its Python binding always announces the members of a type, and two of its types match by their names, so the header
    of a call has the bridge's.  ``rmw_cyclonedds_cpp`` announces none.
    """

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._made: dict[tuple[str, bool], Any] = {}

    def get(self, name: str, call: bool = False) -> Any:
        """The type of a message; with ``call`` the header of ``rmw_cyclonedds_cpp`` is before its fields."""
        if (name, call) not in self._made:
            fields = {"client": idl.uint64, "call": idl.int64} if call else {}
            fields |= {field: self._type(kind) for field, kind in self._store.fielddefs[name][1]}
            self._made[name, call] = _struct(name, fields)
        return self._made[name, call]

    def _type(self, kind: Any) -> Any:
        node, value = kind
        match node.name:
            case "BASE":
                return PRIMITIVES[value[0]]
            case "NAME":
                return self.get(value)
            case "ARRAY":
                return idl.array[self._type(value[0]), value[1]]
            case _:
                return idl.sequence[self._type(value[0])]


def _struct(name: str, fields: dict[str, Any]) -> Any:
    package, kind, short = name.split("/")

    def body(namespace: dict[str, Any]) -> None:
        namespace["__annotations__"] |= fields

    made = new_class(short, (IdlStruct,), {"typename": f"{package}::{kind}::dds_::{short}_"}, body)
    return dataclass(made)
