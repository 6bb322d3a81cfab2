"""The sigmoid law of Wang et al. (2004): the force, its extension, its fit problems, its laws."""
