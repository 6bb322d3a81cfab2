"""The sigmoid law of Wang et al. (2004): force, extension, fit problems and laws."""
