"""The best gait, by exact gradients and by others, on the paper's rung and on real ground."""
