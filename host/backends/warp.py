"""NVIDIA Warp: warp:cpu (one thread, one lane) and warp:cuda:N."""


def probe():
    return []
