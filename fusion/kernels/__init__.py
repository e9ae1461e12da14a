"""Compiled loops of the particle filter and smoother: numba, counter-based randomness, no state."""
