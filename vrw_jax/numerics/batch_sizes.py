"""Batch sizes: the number of elements that one call of a compiled program computes.

A larger batch costs less per element, and a smaller batch wastes less memory and padding. If
several sizes are given, a batch is padded to the smallest size that holds it, and each size is
compiled once.
"""

DIFFRAX_BATCH_SIZE = 256
"""Number of gait steps by the diffrax engine, chosen because its loop runs until the slowest
element ends.
"""
XLA_LANE_BATCH_SIZE = 32_768
"""Number of gait steps of the "lanes" engine by XLA, chosen because a GPU needs many lanes."""
CONTACT_XLA_BATCH_SIZE = 2048
"""Number of steps with unilateral contact by XLA, on devices without machine code."""
ATTRACTOR_BATCH_SIZE = 128
"""Number of walks toward attractors; after each round, the remaining walks are gathered in new
batches.
"""
DISTURBANCE_BATCH_SIZES = (64, 1024)
"""Numbers of disturbed steps, for one size at each instant or for many."""
GAIT_BATCH_SIZES = (8, 64, 512, 4096)
"""Numbers of limit cycles of the paper's wheel, which one Newton iteration computes together."""
CONTACT_GAIT_BATCH_SIZES = (1, 8, 64, 512)
"""Numbers of limit cycles with unilateral contact, which need few iterations of expensive steps."""

BRANCH_BATCH_SIZE = 8
"""Number of branches continued together, chosen because they fill one group of lanes of machine
code.
"""
LOCATION_BATCH_SIZES = (1, 8)
"""Numbers of special points located by one call; only one size is compiled if compilation is
expensive.
"""
POINT_BATCH_SIZE = 32
"""Number of points of branches measured by one call, chosen because fewer points take the same
time.
"""
CURVE_BATCH_SIZE = 8
"""Number of curves of special points traced together, fixed so that one shape is compiled."""
SCAN_BATCH_SIZE = 512
"""Number of samples of a scan computed by one call, fixed so that results do not depend on other
samples.
"""
SCAN_TASK_SIZE = 512
"""Largest number of samples with unilateral contact that one task of a thread computes."""
GAIT_READ_BATCH_SIZE = 64
"""Number of gaits with unilateral contact measured by one call, fixed as for scans."""
SCAN_CHUNK_SIZE = 4096
"""Default number of samples of a scan that are written together; a killed scan may lose as many."""
