"""The ROS 2 nodes, which convert parameters and messages; other parts of the package compute.

This is the only part of the package that imports rclpy.
"""
