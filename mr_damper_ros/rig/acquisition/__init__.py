"""What live sources share: devices read in the background, formats, times, blocks."""
