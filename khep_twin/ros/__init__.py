"""Robots and twins as nodes of ROS 2, over Zenoh as rmw_zenoh does it, without an installation of ROS."""
