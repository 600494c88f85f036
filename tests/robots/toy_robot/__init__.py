"""The Toy: a robot with two wheels, five infrared sensors and an ultrasonic one, for docs/robots.md."""
