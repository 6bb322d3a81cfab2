# %% [markdown]
# # Many recordings to one set, and the next run
#
# Runs at several amplitudes, frequencies and currents determine one parameter set for all of
# them. The bags are not original recordings: they are re-synthesised from a thesis, which published
# one set per condition (`bags/README.md`). A single set for all conditions therefore has a model
# error, as on a real damper.

# %%
import mr_damper_ros as mr

bags = ["bags/5.0mm_1Hz_0.5A", "bags/7.5mm_1Hz_1.0A", "bags/5.0mm_1Hz_1.5A"]
result = mr.identify(bags)
print(result)

# %% [markdown]
# The standard error of a parameter contains all uncertainty; the discrepancy is the part that is
# model error. `determination` lists the combinations of parameters that the runs do not determine,
# and the recommended next runs.

# %%
print(result.determination())

# %% [markdown]
# Cross-validation: leave out one run at a time and validate the set of the others on it.

# %%
for left_out in bags:
    others = mr.identify([bag for bag in bags if bag != left_out])
    print(mr.validate(others.parameter_set, left_out))
