"""Sources of samples: one file each, and one line here."""

from mr_damper_ros.rig.sources.bag_source import BagSource
from mr_damper_ros.rig.sources.emulated_source import EmulatedSource
from mr_damper_ros.rig.sources.record_source import RecordSource
from mr_damper_ros.rig.sources.source import Source

SOURCES: dict[str, type[Source]] = {
    "bag": BagSource,
    "record": RecordSource,
    "emulated": EmulatedSource,
}
"""By the name that the parameter ``source`` of the bridge has for each."""
