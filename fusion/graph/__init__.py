"""Parts of the factor graph: whole likelihoods seen through Gaussian windows, their factors, the graph's solution."""
