"""Paper A's twelve configurations of logs: camera, perception, grasp plan and crane on the bus."""
