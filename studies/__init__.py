"""Studies: programs that train policies in order to show something about them. What measures speed is in ``benchmarks``."""
