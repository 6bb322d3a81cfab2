"""Identification of the sigmoid law from windows of motion and force: no ROS, no files."""
