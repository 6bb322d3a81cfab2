"""Production lots: many dampers from many recordings."""
