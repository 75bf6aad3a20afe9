"""Message types of Autoware and of Ackermann drives, for bags that do not bring their definitions along.

ROS 2 recorded to SQLite without definitions until Iron. Fields and their order are all that the bytes need. Where a
type has changed, the layouts stand one after the other, the newest first; a message fits one of them only.
"""

from __future__ import annotations

from collections.abc import Mapping

_STAMP = "builtin_interfaces/Time stamp\n"
_TIMES = _STAMP + "builtin_interfaces/Time control_time\n"
_HEADER = "std_msgs/Header header\n"
_STEERING = "float32 steering_tire_angle\nfloat32 steering_tire_rotation_rate\n"
_LATERAL = _STEERING + "bool is_defined_steering_tire_rotation_rate\n"
_LONGITUDINAL = (
    "float32 velocity\nfloat32 acceleration\nfloat32 jerk\nbool is_defined_acceleration\nbool is_defined_jerk\n"
)
_VELOCITY = _HEADER + "float32 longitudinal_velocity\nfloat32 lateral_velocity\nfloat32 heading_rate\n"
_CONTROL = "Lateral lateral\nLongitudinal longitudinal\n"
_ACKERMANN = (
    "float32 steering_angle\nfloat32 steering_angle_velocity\nfloat32 speed\nfloat32 acceleration\nfloat32 jerk\n"
)

LAYOUTS: tuple[Mapping[str, str], ...] = (
    {
        "autoware_control_msgs/msg/Control": _TIMES + _CONTROL,
        "autoware_control_msgs/msg/Lateral": _TIMES + _LATERAL,
        "autoware_control_msgs/msg/Longitudinal": _TIMES + _LONGITUDINAL,
        "autoware_vehicle_msgs/msg/VelocityReport": _VELOCITY,
        "autoware_vehicle_msgs/msg/ControlModeReport": _STAMP + "uint8 mode\n",
        "autoware_vehicle_msgs/msg/SteeringReport": _STAMP + "float32 steering_tire_angle\n",
        "autoware_vehicle_msgs/msg/GearReport": _STAMP + "uint8 report\n",
        "autoware_auto_control_msgs/msg/AckermannControlCommand": (
            _STAMP + "AckermannLateralCommand lateral\nLongitudinalCommand longitudinal\n"
        ),
        "autoware_auto_control_msgs/msg/AckermannLateralCommand": _STAMP + _STEERING,
        "autoware_auto_control_msgs/msg/LongitudinalCommand": (
            _STAMP + "float32 speed\nfloat32 acceleration\nfloat32 jerk\n"
        ),
        "autoware_auto_vehicle_msgs/msg/VelocityReport": _VELOCITY,
        "autoware_auto_vehicle_msgs/msg/ControlModeReport": _STAMP + "uint8 mode\n",
        "autoware_auto_vehicle_msgs/msg/SteeringReport": _STAMP + "float32 steering_tire_angle\n",
        "ackermann_msgs/msg/AckermannDrive": _ACKERMANN,
        "ackermann_msgs/msg/AckermannDriveStamped": _HEADER + "AckermannDrive drive\n",
    },
    {
        "autoware_control_msgs/msg/Control": _STAMP + _CONTROL,
        "autoware_control_msgs/msg/Lateral": _STAMP + _LATERAL,
        "autoware_control_msgs/msg/Longitudinal": _STAMP + _LONGITUDINAL,
    },
)
"""By type: the fields, one a line, as in a ``.msg`` file. A later entry replaces those of the first for its types."""
