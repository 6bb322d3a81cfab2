"""Force laws of MR dampers behind one interface, their parameters, and sets of these.

A new law is one class here and one line in :data:`MODELS`.
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
"""Models by name, in the order of the thesis' review (table 2)."""
