"""Batch sizes: how many elements one call of a compiled program computes.

A larger batch costs less per element; a smaller one wastes less on padding and memory. Where
several sizes are given, a batch is padded to the least size that holds it, and each size is
compiled once.
"""

DIFFRAX_BATCH_SIZE = 256
"""Gait steps by the diffrax engine, chosen because its loop runs until the slowest element ends."""
XLA_LANE_BATCH_SIZE = 32_768
"""Gait steps of the "lanes" engine by XLA, chosen because a GPU needs many lanes."""
CONTACT_XLA_BATCH_SIZE = 2048
"""Steps with unilateral contact by XLA, which have no machine code on that device."""
UNEVEN_GROUND_BATCH_SIZES = (16, 256)
"""Walks with unilateral contact on uneven ground by the diffrax engine."""
ATTRACTOR_BATCH_SIZE = 128
"""Walks toward attractors; stragglers are gathered in new batches after each round."""
GAIT_BATCH_SIZES = (8, 64, 512, 4096)
"""Limit cycles of the paper's wheel, which one Newton iteration computes for all elements."""
CONTACT_GAIT_BATCH_SIZES = (1, 8, 64, 512)
"""Limit cycles with unilateral contact, which need few iterations and expensive steps."""
