"""Supplies of current: instruments that speak SCPI, and what they shall give."""
