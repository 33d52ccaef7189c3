"""Batch sizes: numbers of elements that one call of a compiled program computes.

A larger batch costs less per element, whereas a smaller batch wastes less memory and padding. If
there are several sizes, a batch is padded to the smallest size that can contain it. Each size is
compiled once.
"""

DIFFRAX_BATCH_SIZE = 256
"""Number of walking steps that one call with the diffrax engine computes. The value is chosen
because the loop of this engine runs until the slowest element ends.
"""
XLA_LANE_BATCH_SIZE = 32_768
"""Number of walking steps that one call of the "lanes" engine computes if XLA compiles it. The
value is chosen because a GPU needs many batch elements.
"""
CONTACT_XLA_BATCH_SIZE = 2048
"""Number of steps with unilateral contact that one XLA call computes, on devices without machine
code.
"""
DISTURBANCE_BATCH_SIZES = (64, 1024)
"""Numbers of disturbed steps that one call computes: one disturbance size at each instant, or
many.
"""
GAIT_BATCH_SIZES = (1, 8, 64, 512, 4096)
"""Numbers of limit cycles of the paper's model that one Newton iteration computes together."""
CONTACT_GAIT_BATCH_SIZES = (1, 8, 64, 512)
"""Numbers of limit cycles with unilateral contact that are computed together. Their search needs
few iterations, but their steps are expensive.
"""

LOCATION_BATCH_SIZES = (1, 8)
"""Numbers of special points that one call locates. Only one size is compiled if compilation is
expensive.
"""
CURVE_BATCH_SIZE = 8
"""Number of curves of special points that are traced together, fixed so that one shape is
compiled.
"""
SCAN_BATCH_SIZE = 512
"""Number of samples of a scan that one call computes, fixed so that the results for a sample do not
depend on other samples.
"""
GPU_SCAN_BATCH_SIZE = 4096
"""Number of samples of a scan that one call on a GPU computes, chosen because it is the default
size of a chunk.
"""
SCAN_TASK_SIZE = 512
"""Largest number of samples with unilateral contact that one thread task computes."""
GAIT_READ_BATCH_SIZE = 64
"""Number of gaits with unilateral contact that one call measures, fixed for the same reason as
`SCAN_BATCH_SIZE`.
"""
SCAN_CHUNK_SIZE = 4096
"""Default number of samples of a scan that are written together. A scan that is killed may lose as
many samples.
"""
