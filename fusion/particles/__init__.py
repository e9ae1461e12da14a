"""The parts of the particle filter and smoother."""
