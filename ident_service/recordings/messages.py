"""Provide the ROS 2 message definitions for recordings, as `ros2msg` text with their dependencies.

A reader that knows nothing of ROS packages finds here all it needs: after the message's own definition comes each
type it uses, behind a line of `=` and a line `MSG: package/Type`. `ident_msgs/msg/Cycle` is our own.
"""

from __future__ import annotations

from typing import Final

_SEPARATOR: Final = "=" * 80

_TIME: Final = "int32 sec\nuint32 nanosec\n"
_HEADER: Final = "builtin_interfaces/Time stamp\nstring frame_id\n"

_JOINT_STATE: Final = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
"""

_LOG: Final = """\
byte DEBUG=10
byte INFO=20
byte WARN=30
byte ERROR=40
byte FATAL=50
builtin_interfaces/Time stamp
uint8 level
string name
string msg
string file
string function
uint32 line
"""

_CYCLE: Final = """\
std_msgs/Header header
uint64 cycle
int64 lateness_ns
int64 compute_ns
bool[] valid
uint32[] age
uint32 lost
"""


def _definition(own: str, *dependencies: tuple[str, str]) -> bytes:
    parts = [own, *(f"{_SEPARATOR}\nMSG: {name}\n{text}" for name, text in dependencies)]
    return "".join(parts).encode()


_TIME_ENTRY: Final = ("builtin_interfaces/Time", _TIME)
_HEADER_ENTRY: Final = ("std_msgs/Header", _HEADER)

JOINT_STATE: Final = "sensor_msgs/msg/JointState"
STRING: Final = "std_msgs/msg/String"
LOG: Final = "rcl_interfaces/msg/Log"
CYCLE: Final = "ident_msgs/msg/Cycle"

DEFINITIONS: Final[dict[str, bytes]] = {
    JOINT_STATE: _definition(_JOINT_STATE, _HEADER_ENTRY, _TIME_ENTRY),
    STRING: _definition("string data\n"),
    LOG: _definition(_LOG, _TIME_ENTRY),
    CYCLE: _definition(_CYCLE, _HEADER_ENTRY, _TIME_ENTRY),
}

TOPICS: Final[dict[str, str]] = {
    "/joint_states": JOINT_STATE,
    "/joint_commands": JOINT_STATE,
    "/joint_torques": JOINT_STATE,
    "/cycle": CYCLE,
    "/events": LOG,
    "/robot_description": STRING,
}
