"""Compare tuning by exact gradients with other optimizers, and the optima of two models."""
