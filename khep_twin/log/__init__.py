"""Logs: every run as one self-contained MCAP file that rerun and Foxglove open by themselves.

channels      what is in a log, as ROS 2 messages
description   the scene as URDF; `foxglove_scene` the same for Foxglove
recorder      writes a log while a world runs; `part_file` is the file meanwhile
reader        a log as arrays
replay        a log in rerun
"""
