"""One check of measured data, for streams and for files: evidence, severity and remedy."""
