"""The parts of the online tracker: buffers, history, checks of what arrives."""
