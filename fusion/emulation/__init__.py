"""Likelihoods with a stated error profile in a network's place; everything made with them says 'emulated'."""
