"""The Scout: a robot 200 mm across, with sensors of the ground, three ultrasonic ones and a battery."""
