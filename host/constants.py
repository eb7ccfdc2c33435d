"""Numbers that the host and the kernels share, under the same names.

Warp and NumPy import them. OpenCL gets those that a file names as build options (``skylamp.opencl.defines``):
a float as a float32 literal, a tuple ``NAME`` as ``NAME_0``, ``NAME_1``, ...
"""

# Numbers of kinds, in order
OPEN, DARK, PERIODIC = range(3)  # surroundings of the map
SIDES = {"open": OPEN, "dark": DARK, "periodic": PERIODIC}
SKY, RECTANGLE, APERTURE, BALL, VOLUME = range(5)  # kinds of sources of a lattice
SLOPES, UNIFORM, TABLE, ANGLES = range(4)  # WHAT the kernel `sweep` makes of slopes, opencl/horizon.cl

# [element], pixel arrays are a multiple of this long, so that kernels read whole vectors at their end
PIXEL_PADDING = 32
# of a map with its margins: Warp counts the bytes from row to row of an array, and kernels nodes, in 32 bits
MOST_PIXELS = 2**29 - PIXEL_PADDING
MOST_FILE_PIXELS = 2**30  # of a file that is read whole; chosen
# lines of a work-group of a sweep on a GPU; on an H200 64 take 9 % more time by OpenCL, 256 12 %
GPU_LINES = 128
GPU_PIXELS = 8  # adjacent pixels per work-item on a GPU where there are no lines

# Heights [spacing] and slopes [tangent]. NONE and HIGHEST_MASKED are chosen: lower than any height that is
# allowed, and higher than -3e38, so that a difference or an interpolation of them is finite in float32.
NONE = -1e30  # height where there is no ground
HIGHEST_MASKED = -1e29  # heights up to this one are no ground
STEEP = 1e6  # tangent that stands for the zenith: its sine is 1 in float32, its cosine 1e-6
ENDLESS = 1e30  # [spacing], distance that no ray ends at
NO_CEILING = 3.4028234663852886e38  # height of the ceiling under open sky: the greatest float32

# Angles
PI, HALF_PI, TWO_PI = 3.14159265, 1.57079633, 6.28318531  # [rad]
# fmt: off
# arctan(r) / r by powers of r^2, the highest first: to 2e-7 for 0 <= r <= 1, fitted for least maximum error
ARC_TANGENT = (
    -0.0040545627, 0.021862943, -0.055912301, 0.096421957, -0.13908629, 0.19946566, -0.33329859, 0.99999934,
)
# the same to 1e-7 for -1 <= r <= 1
CHORD_TANGENT = (
    -0.0046932749, 0.0242524, -0.05948639, 0.09914292, -0.1401948, 0.19969724, -0.3333199, 0.9999999,
)
# fmt: on
TURN_BY_SINE = 0.318, 0.182  # about: share of the circle by the sine s of half the angle: s (a + b s^2)
TURN_BY_TANGENT = 0.637, 0.137  # about: by the tangent t of a quarter of the angle: t (a - b t^2)

# Copies of turned maps, opencl/scan.cl
COPY_SIDE = 4  # [node], side of the square that a work-item copies
PATCH_X, PATCH_Y = 8, 4  # such squares that neighbouring work-items copy: both sides in few cache lines

# Sweeps, opencl/horizon.cl
LADDER = 16  # slopes of the ladder
TILE_ROWS = 16  # rows of heights that a work-group holds in local memory
MOST_TILE = 12288  # floats of local memory that any GPU has, 48 KiB; larger tiles are not made
UNSEEN = 1 - (1 << 30)  # quantized height far below all ground, one row away

# Slices of lamps and windows, opencl/slices.cl
# [node], side of the squares of nodes whose work-items run together on a GPU, as their rays meet the same
# ground: on an H200, 4096 x 4096 nodes, a sphere without lobes takes 23.9 ms with 8,
# 40 with 4 and 25.2 with 16
SQUARE = 8
SLICES = 8  # slices of a node come in multiples of this: lanes of a vector on a CPU

# Light between surfaces, opencl/interreflection.cl
# least share of a node's light that leaves its surroundings, in the light that rounds begin with: without it
# a node without sky among white ground would begin at infinity; chosen
LEAST_ESCAPE = 1e-3
# of 1 + |slope|: ground that a ray misses by less is met, as two kernels may round the same ray's slope
# differently; some eight times what float32 rounds by
GRAZES = 1e-6

# The inverse, opencl/adjoint.cl and gauss_newton.cl
ROUNDING = 1.00001  # a block is left out if its slope is lower by this factor, more than float32 rounds by
# component of a unit vector below which it is parallel to the grid: n times -1e-9 would be a crossing all but
# on a node, and one of its two nodes off the map
PARALLEL = 1e-6
# slope below which ground of a periodic map is not searched for: at most 5e-5 of E / pi
LEAST_SEARCHED_SLOPE = 0.01
TILE = 8  # [node], side of the squares whose greatest height is known
NODES_PER_SUM = 16  # nodes that a work-item of a sum owns
LINK_BLOCK = 32  # nodes whose links are interleaved: a GPU reads them at once, and a CPU's cache holds them
SUM_SLOTS = 32  # integers over which a sum is spread, so that few work-items add to the same one
COARSENING = 4  # ratio of the spacings of a grid of the preconditioner and the next finer one
# The state of conjugate gradients, opencl/gauss_newton.cl
LEFT, SCATTERED, UNIT_RV, UNIT_VV, PRODUCT, ALPHA, START, GAIN, LAMBDA, DAMPING, STOP_RATIO, STATE = range(12)
