"""The parameters of the identifier node: those of the identification, and the node's own."""

from __future__ import annotations

from dataclasses import dataclass

from mr_damper_ros.settings.option_table import ParameterTable, group, option
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.pipeline import PipelineSettings
from mr_damper_ros.tracking.tracker_settings import TrackerSettings
from mr_damper_ros.tracking.window_assembler import WindowSettings


@dataclass(frozen=True)
class IdentifierParameters(ParameterTable):
    """Parameters of the identifier node."""

    windows: WindowSettings = group(WindowSettings, flat=True, read_only=True)
    grid: GridSettings = group(GridSettings, flat=True, read_only=True)
    tracking: TrackerSettings = group(TrackerSettings, flat=True, read_only=True)
    work: PipelineSettings = group(PipelineSettings, flat=True, read_only=True)
    initial_parameters: str = option(
        "literature",
        "Parameter file (YAML) to start from; 'literature' for the published start of the "
        "thesis' searches (for a model other than the sigmoid law: from the first window).",
        read_only=True,
    )
    state_dir: str = option(
        "",
        "Folder in which parameter sets are kept: the running one, read again at the next start, "
        "and those of the services save_parameters and load_parameters. Empty: nothing is kept.",
        read_only=True,
    )
    frame_id: str = option("damper", "Frame of the published messages.", read_only=True)
