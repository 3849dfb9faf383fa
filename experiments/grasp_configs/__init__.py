"""Paper A's twelve configurations of logs: camera, perception, grasp plan, crane on the bus, judged by the physics."""
