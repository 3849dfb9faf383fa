"""From a goal of FollowJointTrajectory to setpoints for the controller; pure, without a socket or a clock."""
