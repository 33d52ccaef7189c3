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

BRANCH_BATCH_SIZE = 8
"""Branches continued at a time, chosen because they fill one group of lanes of machine code."""
LOCATION_BATCH_SIZES = (1, 8)
"""Special points located by one call; only one size is compiled if compilation is expensive."""
POINT_BATCH_SIZE = 32
"""Points of branches measured by one call, chosen because fewer points take the same time."""
CURVE_BATCH_SIZE = 8
"""Curves of special points traced at a time, fixed so that one shape is compiled."""
SCAN_BATCH_SIZE = 512
"""Samples of a scan computed by one call, fixed so that they do not depend on other samples."""
SCAN_TASK_SIZE = 512
"""Samples with unilateral contact that one task of a thread computes at most."""
GAIT_READ_BATCH_SIZE = 64
"""Gaits with unilateral contact measured by one call, fixed as for scans."""
SCAN_CHUNK_SIZE = 4096
"""Samples of a scan that are written at a time by default, which a killed scan may lose."""
