"""What a bag of a rig holds: the topics, their message types, and what can be wrong with it."""

from __future__ import annotations

MTS_TOPIC = "/mts/samples"
CURRENT_TOPIC = "/supply/current"
TEMPERATURE_TOPIC = "/temperature"

SAMPLES_TYPE = "mr_damper_msgs/msg/MtsSamples"
CURRENT_TYPE = "mr_damper_msgs/msg/SupplyCurrent"
TEMPERATURE_TYPE = "sensor_msgs/msg/Temperature"


class BagError(ValueError):
    """A bag that cannot be read or written; the message says what to change."""
