"""The bridge to ROS 2: the machine as a ROS 2 node on the wire of Cyclone DDS, without an installation of ROS."""
