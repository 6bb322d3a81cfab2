"""The Python interface for recordings, available from ``import mr_damper_ros``."""
