"""From a wanted force to a current: inverse laws, control of the force, what is wanted of it."""
