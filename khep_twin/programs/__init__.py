"""Programs that were compiled for a robot's computer, run on this computer against a twin of the robot."""
