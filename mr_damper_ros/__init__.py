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

if TYPE_CHECKING:  # a type checker reads these imports, the program the table below
    from mr_damper_ros.api.check import DataCheck as DataCheck
    from mr_damper_ros.api.check import check as check
    from mr_damper_ros.api.comparison import Validation as Validation
    from mr_damper_ros.api.comparison import validate as validate
    from mr_damper_ros.api.identification import Identification as Identification
    from mr_damper_ros.api.identification import choose_law as choose_law
    from mr_damper_ros.api.identification import identify as identify
    from mr_damper_ros.api.many_recordings import IdentifiedRecording as IdentifiedRecording
    from mr_damper_ros.api.many_recordings import identify_many as identify_many
    from mr_damper_ros.api.replay import Replay as Replay
    from mr_damper_ros.api.replay import follow as follow
    from mr_damper_ros.api.replay import replay as replay
    from mr_damper_ros.campaign.course import ForceCampaign as ForceCampaign
    from mr_damper_ros.campaign.course import run_campaign as run_campaign
    from mr_damper_ros.control.inverse_model import InverseModel as InverseModel
    from mr_damper_ros.data_check.findings import Finding as Finding
    from mr_damper_ros.estimation.experiment_design import ForceGoal as ForceGoal
    from mr_damper_ros.estimation.experiment_design import MachineLimits as MachineLimits
    from mr_damper_ros.estimation.experiment_design import PlannedRun as PlannedRun
    from mr_damper_ros.estimation.law_choice import LawChoice as LawChoice
    from mr_damper_ros.io.bag_reader import read_bag as read_bag
    from mr_damper_ros.io.bag_writer import write_bag as write_bag
    from mr_damper_ros.io.records import read_record as read_record
    from mr_damper_ros.io.records import read_runs as read_runs
    from mr_damper_ros.models import MODELS as MODELS
    from mr_damper_ros.models.parameter_set import ParameterSet as ParameterSet
    from mr_damper_ros.signals.blocks import SampleBlock as SampleBlock
    from mr_damper_ros.signals.recording import Recording as Recording
    from mr_damper_ros.tracking.engine import Engine as Engine
    from mr_damper_ros.tracking.engine import EngineSettings as EngineSettings
    from mr_damper_ros.tracking.predictor import ForcePredictor as ForcePredictor
    from mr_damper_ros.tracking.predictor import PredictorSettings as PredictorSettings
    from mr_damper_ros.tracking.tracker import TrackerSettings as TrackerSettings
    from mr_damper_ros.tracking.tracker import WindowTracker as WindowTracker

_NAMES = {
    "api.check": ("DataCheck", "check"),
    "api.comparison": ("Validation", "validate"),
    "api.identification": ("Identification", "choose_law", "identify"),
    "api.many_recordings": ("IdentifiedRecording", "identify_many"),
    "api.replay": ("Replay", "follow", "replay"),
    "campaign.course": ("ForceCampaign", "run_campaign"),
    "control.inverse_model": ("InverseModel",),
    "data_check.findings": ("Finding",),
    "estimation.law_choice": ("LawChoice",),
    "estimation.experiment_design": ("ForceGoal", "MachineLimits", "PlannedRun"),
    "io.bag_reader": ("read_bag",),
    "io.bag_writer": ("write_bag",),
    "io.records": ("read_record", "read_runs"),
    "models": ("MODELS",),
    "models.parameter_set": ("ParameterSet",),
    "signals.blocks": ("SampleBlock",),
    "signals.recording": ("Recording",),
    "tracking.engine": ("Engine", "EngineSettings"),
    "tracking.predictor": ("ForcePredictor", "PredictorSettings"),
    "tracking.tracker": ("TrackerSettings", "WindowTracker"),
}
"""The names of the interface, by module."""

_HOMES = {name: module for module, names in _NAMES.items() for name in names}
__all__ = sorted(_HOMES)

if not TYPE_CHECKING:

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
