"""Options with defaults, descriptions and ranges, and tables of options."""
