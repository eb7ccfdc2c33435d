"""Warp twins of the OpenCL kernels: only kernels and device functions, no launches.

A kernel that needs the number of elevations per walk at compile time stands in a function of that number,
which plays the part of OpenCL's -D BITS and gives the same kernel every time it is asked.
"""

OPTIONS = {
    "fuse_fp": False,
    "fast_math": False,
    "enable_backward": False,
    "default_grid_stride": False,
}  # one rounding per operation, as in OpenCL; a thread per element
AHEAD = 16  # depths that a scan fetches before it uses them
GROUP = 512  # most threads of a block of scan; neighbouring lines of a block share cache lines
