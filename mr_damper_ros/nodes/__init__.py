"""The ROS 2 nodes: parameters in, messages in and out; all computation is done by the layers below.

This is the only part of the package that imports rclpy.
"""
