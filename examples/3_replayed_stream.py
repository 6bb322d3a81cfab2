# %% [markdown]
# # A recording as a stream: what the nodes would have published
#
# `replay` feeds a recording to the engine of the nodes identifier and model, at default settings.
# Over ROS, the same bag gives identical numbers. (The bag is re-synthesised from published
# parameters, see `bags/README.md`.)

# %%
from pathlib import Path

import numpy as np

import mr_damper_ros as mr

replayed = mr.replay("bags/5.0mm_1Hz_1.5A")
print(replayed)

# %% [markdown]
# Every window has a report: the errors of the set in use and of the new set on validation
# samples, and why the new set was accepted or rejected.

# %%
for report in replayed.reports:
    print(f"{replayed.time_of(report):.1f} s: {report.verdict.name}, {report.set_id}")

# %% [markdown]
# The force is predicted from past samples only, and each sample is valid or invalid. No force is
# valid before the first window has been identified.

# %%
first = replayed.time[np.argmax(replayed.valid)]
print(f"the force is valid from {first:.2f} s on, for {replayed.valid.mean():.1%} of the time")
for doubt, share in replayed.invalid_share().items():
    print(f"  {doubt.name}: {share:.1%}")
folder = Path("build/examples")
folder.mkdir(parents=True, exist_ok=True)
replayed.plot().savefig(folder / "replayed_stream.png")

# %% [markdown]
# A recording consists of arrays that can be changed: here, the load cell comes loose at 4 s.

# %%
(run,) = mr.read_bag("bags/5.0mm_1Hz_1.5A")
force = np.where(np.arange(run.force.size) * run.period < 4.0, run.force, 0.6 * run.force)
loose = mr.Recording(
    "loose load cell", run.start_ns, run.period, run.displacement, force, run.current
)
print(mr.replay(loose))
