# %% [markdown]
# # One recording to a figure
#
# A test machine has written time, displacement and force to a text file; the current was constant.
# Run this file as it is, or open it as a notebook (Jupytext).

# %%
from pathlib import Path

import mr_damper_ros as mr

run = mr.read_record("doc/example.csv", "time:s,displacement:mm,force:N", current=0.5)
print(f"{run.name}: {run.force.size} samples, {run.period * 1e3:g} ms apart")

# %% [markdown]
# The units of the columns are given once; from here on all values are in SI units, extension and
# tension positive. A single motion at a single current determines seven coefficients. Sixteen
# parameters describe how these depend on velocity and current; those that this run does not
# determine are marked *not observable*.

# %%
result = mr.identify(run)
print(result)

# %% [markdown]
# The NRMSE is the root mean square of the residual over the standard deviation of the force. In the
# figure, model error repeats in every cycle; noise does not.

# %%
folder = Path("build/examples")
folder.mkdir(parents=True, exist_ok=True)
result.plot().savefig(folder / "one_recording.png")
result.save(folder / "damper.yaml")
