"""Sources of samples: one module each, and one entry in ``SOURCES``."""

from mr_damper_ros.rig.sources.daq_source import DaqSource
from mr_damper_ros.rig.sources.emulated_source import EmulatedSource, QuarterCarSource
from mr_damper_ros.rig.sources.recorded_source import BagSource, RecordSource
from mr_damper_ros.rig.sources.source import Source
from mr_damper_ros.rig.sources.stream_source import StreamSource

SOURCES: dict[str, type[Source]] = {
    "bag": BagSource,
    "record": RecordSource,
    "quarter_car": QuarterCarSource,
    "emulated": EmulatedSource,
    "stream": StreamSource,
    "daq": DaqSource,
}
"""Source classes by the value of the bridge's parameter ``source``."""
