# %% [markdown]
# # A controller for an identified damper
#
# The inverse of the law gives the current for a desired force. The second part simulates a quarter
# car with skyhook control; the last part exports the inverse as code. All of this is simulated; the
# bags are re-synthesised (`bags/README.md`).

# %%
from pathlib import Path

import numpy as np

import mr_damper_ros as mr
from mr_damper_ros.kinematics.motion import Motion

damper = mr.identify(
    ["bags/5.0mm_1Hz_0.5A", "bags/7.5mm_1Hz_1.0A", "bags/5.0mm_1Hz_1.5A"]
).parameter_set
inverse = mr.InverseModel(damper, 0.5, 1.5)
moving = Motion(
    displacement=np.zeros(3),
    velocity=np.full(3, 0.03),
    acceleration=np.full(3, 0.1),
    peak_velocity=np.full(3, 0.031),
    sine=None,
)
found = inverse.currents(moving, [700.0, 900.0, -300.0])
for current, force, attainable in zip(found.current, found.force, found.attainable, strict=True):
    print(
        f"{current:.2f} A gives {force:.0f} N"
        + ("" if attainable else ", the nearest attainable force")
    )

# %% [markdown]
# A quarter car drives on an average road (ISO 8608, class C) at 20 m/s. The node `controller` runs
# the same `ForceController`.

# %%
from mr_damper_ros.control.force_controller import ForceControlSettings
from mr_damper_ros.control.linear_plant import IsoRoad, QuarterCar
from mr_damper_ros.control.semi_active import skyhook
from mr_damper_ros.emulation.commanded_rig import ForceChoice, commanded
from mr_damper_ros.emulation.emulator import (
    HIGHEST_CURRENT,
    EmulatedDamper,
    PlantRig,
    RigSettings,
    SupplySetpoint,
    invented_damper,
)
from mr_damper_ros.rig.sources.emulated_source import suspension_state_of

COIL = 0.01  # time constant of the coil [s]
SETTLED = 2.0


def comfort(controlled: bool) -> float:
    """RMS of the body acceleration [m/s2] over eight seconds of road."""
    supply = SupplySetpoint(0.0)
    rig = PlantRig(
        EmulatedDamper(invented_damper(COIL), built_in=True),
        QuarterCar().plant,
        IsoRoad("C", speed=20.0, seed=1),
        supply,
        settings=RigSettings(displacement_noise=1e-6),
        coil_time_constant=COIL,
    )
    settings = ForceControlSettings(highest_current=HIGHEST_CURRENT)
    wanted = skyhook(3000.0)
    known = invented_damper(COIL)
    choice = ForceChoice(settings, known, lambda _: wanted(suspension_state_of(rig)))
    blocks = commanded(rig, supply, choice if controlled else lambda _: 0.0, 10, 10.0)
    body = np.concatenate([block.motion.rates[:, 1] for block in blocks])
    return float(np.std(body[round(SETTLED * rig.settings.sample_rate) :]))


print(f"passive, 0 A: {comfort(False):.2f} m/s2; skyhook: {comfort(True):.2f} m/s2")

# %% [markdown]
# Save the set, then export the law and its inverse as C, M-code or an FMU:
#
# ```bash
# mr-damper export build/examples/whole.yaml --format fmu --output build/examples
# ```

# %%
folder = Path("build/examples")
folder.mkdir(parents=True, exist_ok=True)
damper.save(folder / "whole.yaml")
