"""From sampled displacement to velocity, acceleration and peak velocity of the cycle."""
