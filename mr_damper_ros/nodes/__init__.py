"""The ROS 2 nodes: they convert parameters and messages, and the layers below do the computation.

This is the only part of the package that imports rclpy.
"""
