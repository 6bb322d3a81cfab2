"""Studies that end in a report: controllers (``make control``), force laws (``make truth``)."""
