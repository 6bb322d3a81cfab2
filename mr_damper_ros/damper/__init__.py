"""The force law of the damper and its parameters: arrays in, arrays out, no ROS, no files."""
