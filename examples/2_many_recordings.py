# %% [markdown]
# # Many recordings to one set, and the run to make next
#
# Runs at several amplitudes, frequencies and currents determine one set of parameters for all of
# them. The bags here are re-synthesised from the parameters that a thesis published for each
# condition (`bags/README.md`); they are no original recordings, and the conditions were published
# with a set each. So one set for all leaves more than the noise, as on a real damper.

# %%
import mr_damper_ros as mr

bags = ["bags/5.0mm_1Hz_0.5A", "bags/7.5mm_1Hz_1.0A", "bags/5.0mm_1Hz_1.5A"]
result = mr.identify(bags)
print(result)

# %% [markdown]
# A standard error tells the scatter that noise makes; the discrepancy beside it what another motion
# may say, since no law follows a damper exactly. `determination` tells which combinations of
# parameters the runs leave open, and which run to make next.

# %%
print(result.determination())

# %% [markdown]
# How good is the set where it was not fitted? Leave one run out, and judge it there.

# %%
for left_out in bags:
    others = mr.identify([bag for bag in bags if bag != left_out])
    print(mr.validate(others.parameter_set, left_out))
