"""The Python interface: what ``import mr_damper_ros`` offers for recordings."""
