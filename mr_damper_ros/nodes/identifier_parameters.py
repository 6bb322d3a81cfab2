"""The parameters of the identifier node: those of the identification, and the node's own."""

from __future__ import annotations

from dataclasses import dataclass

from mr_damper_ros.settings.option_table import ParameterTable, group, option
from mr_damper_ros.signals.uniform_grid import GridSettings
from mr_damper_ros.tracking.identifier import PipelineSettings
from mr_damper_ros.tracking.tracker import TrackerSettings
from mr_damper_ros.tracking.window_assembler import WindowSettings


@dataclass(frozen=True)
class IdentifierParameters(ParameterTable):
    """Parameters of the identifier node.

    Samples and supply current are collected into windows. Each window is fitted, in the order of
    the data, starting from the set in use. The fitted set comes into use if it predicts samples of
    the window that the fit has not seen better than the set before it. Now and then all parameters
    of the law are identified at once, from windows that fit at different operating points (peak
    velocity, current). Only the stamps of the data count, so a bag gives the same sets at any rate
    of replay.
    """

    windows: WindowSettings = group(WindowSettings, flat=True, read_only=True)
    grid: GridSettings = group(GridSettings, flat=True, read_only=True)
    tracking: TrackerSettings = group(TrackerSettings, flat=True, read_only=True)
    work: PipelineSettings = group(PipelineSettings, flat=True, read_only=True)
    initial_parameters: str = option(
        "literature",
        "Parameter file (YAML) to start from, for example one written by `identify` or by the "
        "service ~/save_parameters; or literature, the start of the thesis' searches (a model "
        "other than the sigmoid law then starts from what it reads off the first window). The "
        "service ~/reset goes back to it. The ranges that a file states stay until samples refute "
        "them: a window at one current says how strong the damper is, not that it is unknown at "
        "all others.",
        read_only=True,
    )
    state_dir: str = option(
        "",
        'Folder in which parameter sets are kept, "" for none: the set in use, under the name of '
        "the node, with all that has been learnt besides (baselines, reservoir, usual residual), "
        "which is read again at the next start; and those of the services ~/save_parameters and "
        "~/load_parameters, which take plain names, no paths. A damaged file, or one of another "
        "model or a newer version, or that cannot be a damper's, is never used: it is renamed and "
        "named in the diagnostics until the service ~/acknowledge is called. A folder and a name "
        "of a node belong to one node at a time.",
        read_only=True,
    )
    frame_id: str = option(
        "damper", "Frame of the published messages, x along the damper's rod.", read_only=True
    )
