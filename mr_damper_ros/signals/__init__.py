"""Signals of a stream: arrays, stamped blocks, clocks, the zero-order hold and recordings."""
