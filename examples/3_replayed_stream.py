# %% [markdown]
# # A recording as a stream: what the nodes would have said
#
# `replay` gives a recording to the engine that the identifier and the model run, at their default
# settings and by the stamps of the data. Over ROS the same bag gives the same numbers. (The bag is
# re-synthesised from published parameters, see `bags/README.md`.)

# %%
from pathlib import Path

import numpy as np

import mr_damper_ros as mr

replayed = mr.replay("bags/5.0mm_1Hz_1.5A")
print(replayed)

# %% [markdown]
# There is a report on every window: what the set in use and the new one leave of samples that
# neither has seen, and why the new one was taken or not.

# %%
for report in replayed.reports:
    print(f"{replayed.time_of(report):.1f} s: {report.verdict.name}, {report.set_id}")

# %% [markdown]
# The force is predicted from past samples alone, and every sample is valid or not. Until the first
# window has been identified nothing is.

# %%
first = replayed.time[np.argmax(replayed.valid)]
print(f"the force is valid from {first:.2f} s on, for {replayed.valid.mean():.1%} of the time")
for doubt, share in replayed.invalid_share().items():
    print(f"  {doubt.name}: {share:.1%}")
folder = Path("build/examples")
folder.mkdir(parents=True, exist_ok=True)
replayed.plot().savefig(folder / "replayed_stream.png")

# %% [markdown]
# What if the load cell came loose at 4 s? A recording is arrays, and can be changed.

# %%
(run,) = mr.read_bag("bags/5.0mm_1Hz_1.5A")
force = np.where(np.arange(run.force.size) * run.period < 4.0, run.force, 0.6 * run.force)
loose = mr.Recording(
    "loose load cell", run.start_ns, run.period, run.displacement, force, run.current
)
print(mr.replay(loose))
