"""The parts of the grid filter and smoother."""
