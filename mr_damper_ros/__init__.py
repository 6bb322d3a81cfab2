"""Identification of magnetorheological dampers and prediction of their force.

The Python interface works without ROS::

    import mr_damper_ros as mr

    run = mr.read_record("run.csv", "time:s,displacement:mm,force:N", current=0.5)
    result = mr.identify(run)
    print(result)
    result.save("damper.yaml")
    result.plot().savefig("damper.png")

Modules are loaded at the first use of a name. All quantities are in SI units; extension and tension
are positive.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mr_damper_ros.api.comparison import Validation, validate
    from mr_damper_ros.api.identification import Identification, choose_law, identify
    from mr_damper_ros.api.replay import Replay, follow, replay
    from mr_damper_ros.campaign.course import ForceCampaign, run_campaign
    from mr_damper_ros.control.inverse_model import InverseModel
    from mr_damper_ros.estimation.law_choice import LawChoice
    from mr_damper_ros.estimation.planned_run import ForceGoal, MachineLimits, PlannedRun
    from mr_damper_ros.io.bag_reader import read_bag
    from mr_damper_ros.io.bag_writer import write_bag
    from mr_damper_ros.io.records import read_record, read_runs
    from mr_damper_ros.lots.many_dampers import ManyDampers, identify_many
    from mr_damper_ros.models import MODELS
    from mr_damper_ros.models.parameter_set import ParameterSet
    from mr_damper_ros.signals.blocks import SampleBlock
    from mr_damper_ros.signals.recording import Recording
    from mr_damper_ros.tracking.engine import Engine, EngineSettings
    from mr_damper_ros.tracking.predictor import ForcePredictor, PredictorSettings
    from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker

__all__ = [
    "MODELS",
    "Engine",
    "EngineSettings",
    "ForceCampaign",
    "ForceGoal",
    "ForcePredictor",
    "Identification",
    "InverseModel",
    "LawChoice",
    "MachineLimits",
    "ManyDampers",
    "ParameterSet",
    "PlannedRun",
    "PredictorSettings",
    "Recording",
    "Replay",
    "SampleBlock",
    "TrackerSettings",
    "Validation",
    "WindowTracker",
    "choose_law",
    "follow",
    "identify",
    "identify_many",
    "read_bag",
    "read_record",
    "read_runs",
    "replay",
    "run_campaign",
    "validate",
    "write_bag",
]

_HOMES = {
    "MODELS": "models",
    "Engine": "tracking.engine",
    "EngineSettings": "tracking.engine",
    "ForceCampaign": "campaign.course",
    "ForceGoal": "estimation.planned_run",
    "ForcePredictor": "tracking.predictor",
    "Identification": "api.identification",
    "LawChoice": "estimation.law_choice",
    "MachineLimits": "estimation.planned_run",
    "ManyDampers": "lots.many_dampers",
    "InverseModel": "control.inverse_model",
    "ParameterSet": "models.parameter_set",
    "PlannedRun": "estimation.planned_run",
    "PredictorSettings": "tracking.predictor",
    "Recording": "signals.recording",
    "Replay": "api.replay",
    "SampleBlock": "signals.blocks",
    "TrackerSettings": "tracking.tracker",
    "Validation": "api.comparison",
    "WindowTracker": "tracking.tracker",
    "choose_law": "api.identification",
    "follow": "api.replay",
    "identify": "api.identification",
    "identify_many": "lots.many_dampers",
    "read_bag": "io.bag_reader",
    "read_record": "io.records",
    "read_runs": "io.records",
    "replay": "api.replay",
    "run_campaign": "campaign.course",
    "validate": "api.comparison",
    "write_bag": "io.bag_writer",
}
"""The module of each name."""

if not TYPE_CHECKING:  # a type checker sees only the imports above

    def __getattr__(name: str) -> object:
        """Load a name of the interface on its first use."""
        if name not in _HOMES:
            raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
        value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        """All names of the interface, loaded or not."""
        return sorted({*globals(), *__all__})
