"""What the machine tells ROS 2: messages made of the controller's reports and of camera frames; pure."""
