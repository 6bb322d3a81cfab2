"""What a stream is made of: arrays, stamped blocks, the zero-order hold, recordings."""
