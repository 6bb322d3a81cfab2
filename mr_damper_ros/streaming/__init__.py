"""Objects that follow a stream of samples by its stamps; the nodes drive them, ROS is not needed."""
