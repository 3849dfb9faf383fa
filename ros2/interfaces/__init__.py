"""The ROS 2 messages that the bridge uses, field by field as their packages publish them (REP 2011, rosidl).

One module for each ROS package.  The name of a type on the wire is that of ``rosidl``: ``package::msg::dds_::Name_``.
No constructor has default values, so that a forgotten field is an error and not a zero.
"""
