"""Numbers that the host shares with kernels, under the same names."""

SIDES = {"open": 0, "dark": 1, "periodic": 2}
SKY, RECTANGLE, APERTURE, BALL, VOLUME = range(5)  # kinds of sources of a lattice

ROOM = 32  # pixel arrays end with room for whole vectors
MOST_PIXELS = 2**30  # kernels count nodes in 32 bits

# of the inverse, opencl/adjoint.cl
SUMMED = 16  # nodes that a work-item of a sum owns
BESIDE = 32  # nodes whose links lie side by side
