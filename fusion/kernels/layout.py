"""How the compiled filter step lays out its memory: the block, a thread's scratch, and the packed numbers it is given.

What Python packs for a pass is two arrays of float64, `motion` and `look`; a position below says where each number
lies. Whole numbers among them are exact: they are below 2^31.
"""

import numpy as np
from numpy.typing import NDArray

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Int32s = NDArray[np.int32]

BLOCK = 512
SCRATCH_SIZE = 10 * BLOCK
"""float32 numbers that one thread needs beside its particles."""

X, Y, T, ADDED, E0, E1, E2, E3, E4, E5 = (row * BLOCK for row in range(10))
"""Where the parts of a thread's scratch begin: pose, what is added to the log weight, noise."""

# rows of a block's sums; those of the arc are filled in when the yaws span the circle
LARGEST, WEIGHT, SQUARED, SUM_X, SUM_Y, SUM_SIN, SUM_COS = 0, 1, 2, 3, 4, 5, 6
SUM_XX, SUM_XY, SUM_YY, SUM_D, SUM_XD, SUM_YD, SUM_DD, FAR = 7, 8, 9, 10, 11, 12, 13, 14
ARC, ARC_X, ARC_Y, ARC_D = 15, 16, 17, 18
SUMS = 19

# motion: arguments of a move
DELTA, ROOT, SHIFT = 0, 3, 12  # increment (3), lower root of its covariance (9, row by row), change of anchor (2)
CENTRE, SHRINK, KERNEL_ROOT, KIND = 14, 17, 18, 27  # regularisation: mean (3), factor, root (9), which kind
MOVED = 28  # not 0 when there is an increment, and not only resampling to carry out
MOTION_SIZE = 29
MOTION_STREAM, KERNEL_STREAM = np.uint32(0), np.uint32(1)
"""Which of the random numbers of a particle and a step are noise of the motion, and which of the kernel."""
NO_KERNEL, ONE_KERNEL, CLUSTER_KERNELS = 0.0, 1.0, 2.0
"""Kinds of regularisation: none, one kernel for everyone, one for each cluster."""

# a cluster's row: mean (3), factor, lower triangle of the kernel's root (6)
CLUSTER_SIZE = 10

# look: arguments of a lookup, the whole numbers last, then the reference pose of the moments
COL_SCALE, COL_SHIFT, ROW_SCALE, ROW_SHIFT, YAW_SCALE = 0, 1, 2, 3, 4
TEMPER_SCALE, TEMPER_SHIFT, FLOOR_BEFORE, FLOOR, INLIER, UNIFORM = 5, 6, 7, 8, 9, 10
ROWS, COLS, BINS, PIXEL_STRIDE, BIN_STRIDE = 11, 12, 13, 14, 15
WEIGH_SIZE = 16
REFERENCE_X, REFERENCE_Y, REFERENCE_YAW, LOG_SHIFT = 16, 17, 18, 19

NOTHING, VOLUME, MAPS = 0, 1, 2
"""What to weigh by."""
