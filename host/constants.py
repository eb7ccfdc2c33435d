"""Numbers that the host and the kernels share, under the same names.

Warp and NumPy import them. OpenCL gets those that a file names as build options (``skylamp.opencl.defines``):
a float as a float32 literal, a tuple ``NAME`` as ``NAME_0``, ``NAME_1``, ...
"""

OPEN, DARK, PERIODIC = range(3)  # what lies beside the map
SIDES = {"open": OPEN, "dark": DARK, "periodic": PERIODIC}
SKY, RECTANGLE, APERTURE, BALL, VOLUME = range(5)  # kinds of sources of a lattice
SLOPES, UNIFORM, TABLE = range(3)  # what a sweep does with the horizon

ROOM = 32  # elements that pixel arrays end with, so that they are read in whole vectors
MOST_PIXELS = 2**30  # kernels count nodes in 32 bits
GPU_LINES = 64  # lines of a work-group of a sweep on a GPU
GPU_PIXELS = 8  # adjacent pixels per work-item on a GPU where there are no lines

# Heights and slopes
NONE = -1e30  # height where there is no ground
MASKED = -1e29  # heights up to this one are no ground
STEEP = 1e6  # tangent as good as the zenith's
ENDLESS = 1e30  # distance that nothing reaches
NOTHING = 3.4028234663852886e38  # the greatest float32: a ceiling where nothing stands above

# Angles
PI, HALF_PI, TWO_PI = 3.14159265, 1.57079633, 6.28318531  # [rad]
# arctan(r) / r by powers of r^2, the highest first: to 2e-7 for 0 <= r <= 1, fitted for least maximum error
ARC_TANGENT = (
    -0.0040545627,
    0.021862943,
    -0.055912301,
    0.096421957,
    -0.13908629,
    0.19946566,
    -0.33329859,
    0.99999934,
)
# the same to 1e-7 for -1 <= r <= 1
CHORD_TANGENT = (
    -0.0046932749,
    0.0242524,
    -0.05948639,
    0.09914292,
    -0.1401948,
    0.19969724,
    -0.3333199,
    0.9999999,
)
TURN_BY_SINE = 0.318, 0.182  # about: share of the circle by the sine s of half the angle: s (a + b s^2)
TURN_BY_TANGENT = 0.637, 0.137  # about: by the tangent t of a quarter of the angle: t (a - b t^2)

# Copies of turned maps, opencl/scan.cl
SIDE = 4  # nodes along a side of the square that a work-item copies
PATCH_X, PATCH_Y = 8, 4  # such squares that neighbouring work-items copy: both sides in few cache lines

# Sweeps, opencl/horizon.cl
LADDER = 16  # slopes of the ladder
TILE_ROWS = 16  # rows of heights that a work-group holds in local memory
UNSEEN = 1 - (1 << 30)  # quantized height far below all ground, one row away

# Slices of lamps and windows, opencl/slices.cl
SLICES = 8  # that a CPU takes at a time

# The inverse, opencl/adjoint.cl
SLACK = 1.00001  # what is left out must be lower by more than roundings
# A slice closer to the grid is along it: n times -1e-9 would be a crossing all but on a node, and one of its
# two nodes off the map.
ALONG = 1e-6
LEVEL = 0.01  # slope below which a map that repeats is not searched
TILE = 8  # nodes along a side of the squares whose greatest height is known
SUMMED = 16  # nodes that a work-item of a sum owns
BESIDE = 32  # nodes whose links lie side by side: a GPU reads them at once, and a CPU's cache holds them
SLOTS = 32  # places that a sum of whole numbers is spread over
FOUR = 4  # times as coarse is every grid that preconditions than the one before
# The state of conjugate gradients, opencl/adjoint.cl
LEFT, SCATTERED, UNIT_RV, UNIT_VV, PRODUCT, ALPHA, START, GAIN, LAMBDA, DAMPING, LEAST, STATE = range(12)
