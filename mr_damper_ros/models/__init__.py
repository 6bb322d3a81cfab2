"""Force laws of MR dampers with one interface, their parameters, and parameter sets.

To add a law, write one class in this package and add one line to :data:`MODELS`.
"""

from mr_damper_ros.models.bouc_wen import BoucWen, ModifiedBoucWen
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.memoryless_laws import Bingham, HyperbolicTangent, NonlinearBiviscous
from mr_damper_ros.models.quantities import Parameter
from mr_damper_ros.models.series_springs import SeriesSprings
from mr_damper_ros.models.sigmoid.sigmoid_model import ExtendedSigmoidModel, SigmoidModel

__all__ = ["MODELS", "Model", "Parameter"]

MODELS: dict[str, Model] = {
    model.name: model
    for model in (
        Bingham(),
        HyperbolicTangent(),
        NonlinearBiviscous(),
        BoucWen(),
        ModifiedBoucWen(),
        SeriesSprings(),
        SigmoidModel(),
        ExtendedSigmoidModel(),
    )
}
"""Models by name, in the order of the review in the thesis (table 2)."""
