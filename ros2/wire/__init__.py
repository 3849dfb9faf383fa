"""ROS 2's conventions on DDS: names, quality of service, the node graph, services and actions.

Sources: ``rmw_cyclonedds_cpp`` and ``rmw_dds_common`` of Jazzy to Lyrical, REP 2016 (type hashes).
"""
