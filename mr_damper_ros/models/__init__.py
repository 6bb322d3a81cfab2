"""Force models of MR dampers behind one interface: those that the thesis reviews (table 2)."""

from mr_damper_ros.models.bouc_wen import BOUC_WEN, MODIFIED_BOUC_WEN
from mr_damper_ros.models.force_model import Model, MotionLike, Parameter
from mr_damper_ros.models.sigmoid.sigmoid_model import EXTENDED_SIGMOID, SIGMOID
from mr_damper_ros.models.static import BINGHAM, HYPERBOLIC_TANGENT, NONLINEAR_BIVISCOUS

__all__ = ["MODELS", "Model", "MotionLike", "Parameter"]

MODELS = {
    model.name: model
    for model in (
        BINGHAM,
        HYPERBOLIC_TANGENT,
        NONLINEAR_BIVISCOUS,
        BOUC_WEN,
        MODIFIED_BOUC_WEN,
        SIGMOID,
        EXTENDED_SIGMOID,
    )
}
"""Models by name, in the order of the thesis' review."""
