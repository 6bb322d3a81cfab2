# %% [markdown]
# # One recording to a figure
#
# A test machine has written time, displacement and force into a text file; the current was constant
# and stands in the log book. Run this file as it is, or open it as a notebook (Jupytext).

# %%
from pathlib import Path

import mr_damper_ros as mr

run = mr.read_record("doc/example.csv", "time:s,displacement:mm,force:N", current=0.5)
print(f"{run.name}: {run.force.size} samples, {run.period * 1e3:g} ms apart")

# %% [markdown]
# Units are stated where the file is read; from here on all is SI, extension and tension positive.
# Of a single motion at a single current seven coefficients can be known. The sixteen parameters say
# how those change with velocity and current: what this run cannot tell is called *not observable*.

# %%
result = mr.identify(run)
print(result)

# %% [markdown]
# The NRMSE is the root mean square of the residual over the standard deviation of the force. The
# figure shows whether what is left is noise, or a shape that the law cannot follow.

# %%
folder = Path("build/examples")
folder.mkdir(parents=True, exist_ok=True)
result.plot().savefig(folder / "one_recording.png")
result.save(folder / "damper.yaml")
