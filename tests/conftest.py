"""Which backends the suite runs on, and how hypothesis draws its examples."""

import os

import pytest
from hypothesis import HealthCheck, settings

# before NumPy is imported: two processes, each with a thread of BLAS for every core, take 9 % longer
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import skylamp as sl  # noqa: E402

settings.register_profile(
    "skylamp",
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=25,
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("skylamp")

# SKYLAMP_TEST_BACKENDS="numpy,warp:cuda:0,opencl" names exactly the backends to use instead; all that are
# named must be there.
NAMED = [name.strip() for name in os.environ.get("SKYLAMP_TEST_BACKENDS", "").split(",") if name.strip()]
MUST = ["numpy", "warp:cpu", "opencl-cpu"]  # missing: a failure, never a skip
MAY = ["warp:cuda:0", "opencl-gpu"]  # missing: a skip that says why


def _parameters():
    return NAMED or MUST + [pytest.param(name, marks=pytest.mark.gpu) for name in MAY]


def _resolved(name):
    """The backend's own name; OpenCL devices by kind, since their numbers differ between machines."""
    if name not in ("opencl-cpu", "opencl-gpu"):
        return name
    fitting = [
        info.name
        for info in sl.backends()
        if info.name.startswith("opencl:") and info.gpu == name.endswith("gpu") and info.available
    ]
    return fitting[0] if fitting else None


def _missing(name):
    why = {info.name: info.why for info in sl.backends() if not info.available}
    if name == "warp:cuda:0":
        return why.get(name)
    return (
        None
        if _resolved(name)
        else f"no {name.replace('-', ' device: ')}" + (f" ({why['opencl']})" if "opencl" in why else "")
    )


@pytest.fixture(scope="session", params=_parameters())
def backend(request):
    """The name of each backend that must be there, and of each GPU that is."""
    if request.param in MAY and not NAMED and (reason := _missing(request.param)):
        pytest.skip(f"{request.param}: {reason}")
    name = _resolved(request.param)
    assert name is not None, f"{request.param} must be here, and is not: {_missing(request.param)}"
    from skylamp.backends import select

    return select(name).name  # raises with the reason where a backend that must be there is not


@pytest.fixture(scope="session")
def fast():
    """One backend for tests of the model itself: OpenCL, or else the first that is named."""
    from skylamp.backends import select

    return select(
        _resolved(next((name for name in NAMED or MUST if name.startswith("opencl")), (NAMED or MUST)[0]))
    ).name


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """A whole file to one process, so that what the oracle says is worked out once."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


def pytest_report_header(config):
    lines = [
        f"skylamp {sl.__version__}; backends under test: {', '.join(NAMED or MUST)}"
        + ("" if NAMED else f"; where there is one: {', '.join(MAY)}")
    ]
    return lines + [
        f"  {info.name}: {info.device if info.available else 'not here: ' + info.why}"
        for info in sl.backends()
    ]
