"""Objects that follow a stream of samples by its stamps; nodes drive them, ROS is not needed."""
