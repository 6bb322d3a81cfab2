"""What may be set: options with their defaults, descriptions and ranges, and tables of them."""
