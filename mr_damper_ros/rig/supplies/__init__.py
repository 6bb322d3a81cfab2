"""Supplies of current: instruments that speak SCPI, and their control."""
