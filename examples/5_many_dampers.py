# %% [markdown]
# # Many dampers on a cluster, and those that differ
#
# The workers of a Dask cluster identify each damper of a series. Here the cluster is two processes
# on this machine, and the recordings are emulated; a list of bags works in the same way. The
# example needs `pip install distributed==2026.8.0 pandas`.

# %%
import numpy as np

import mr_damper_ros as mr
from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings, scaled
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.published import find, parameters

try:
    import dask
    import pandas as pd
    from distributed import Client, LocalCluster
except ImportError as error:
    raise SystemExit(f"{error.name} is missing: pip install distributed==2026.8.0 pandas") from None

USUAL = parameters(find("5.0mm_1Hz_1.5A"))


def recorded(number: int, strength: float) -> mr.Recording:
    """Four seconds of a damper with ``strength`` times the usual force."""
    damper = EmulatedDamper(scaled(USUAL, strength))
    rig = EmulatedRig(damper, SineMotion(5e-3, 1.0), 1.5, settings=RigSettings(seed=number))
    return rig.record(4.0)


# %% [markdown]
# A single run does not determine all parameters, so the comparison uses the largest force of each
# set in the same motion. A damper stands out if it is more than 3.5 standard deviations from the
# median. The median absolute deviation gives the standard deviation, because outliers hardly change
# it (Iglewicz and Hoaglin, 1993).


# %%
def largest_force(result: mr.IdentifiedRecording) -> float:
    """Largest force [N] at 5 mm, 1 Hz and 1.5 A; NaN if the damper was not identified."""
    if result.parameter_set is None:
        return np.nan
    time = np.arange(2000) * 1e-3
    motion = 5e-3 * np.sin(2.0 * np.pi * time)
    return float(np.max(result.parameter_set.force(time, motion, np.full(time.size, 1.5))))


def stand_out(values: pd.Series) -> pd.Series:
    """Whether each value is an outlier."""
    distance = (values - values.median()).abs()
    return distance > 3.5 * 1.4826 * distance.median()


# %% [markdown]
# The forces of twelve dampers lie within 3 %, except for the eighth, which has lost a fifth of it.
# One recording is missing. Its row says so, and the other rows are complete.

# %%
if __name__ == "__main__":  # the processes of the cluster load this file, too
    # By default, Dask lets its workers return memory at once, profiles them, and checks them every
    # 20 to 100 ms, which costs time. More than one thread in BLAS costs time, too.
    environment = {"OMP_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1}
    dask.config.set({"distributed.nanny.pre-spawn-environ": environment})
    dask.config.set({"distributed.worker.profile.enabled": False})
    dask.config.set({"distributed.admin.tick.interval": "1s"})
    dask.config.set({"distributed.worker.memory.monitor-interval": "1s"})
    strengths = np.linspace(0.97, 1.03, 12)
    strengths[7] = 0.8
    recordings = [recorded(number, strength) for number, strength in enumerate(strengths)]
    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        results = mr.identify_many([*recordings, "bags/missing"], client.get_executor())
    table = pd.DataFrame([result.to_dict() for result in results])
    table["largest_force"] = [largest_force(result) for result in results]
    table["outlier"] = stand_out(table["largest_force"])
    print(table[["success", "nrmse", "largest_force", "outlier", "error"]].to_string())
