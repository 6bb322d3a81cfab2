"""Velocity, acceleration and peak velocity, estimated from sampled displacement."""
