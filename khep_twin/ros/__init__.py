"""ROS 2 without an installation of ROS: standard messages, bags and nodes."""
