"""Every test runs with strict dtype promotion and warnings as errors; `x64` switches to float64; `data` finds real files.

Compiling is most of the tests' time, so programs are compiled the quicker way, without what makes them a little faster, and
kept for the next run. With `XLA_FLAGS` set, if only to nothing, they are compiled as users have them.
"""

import gc
import os
from pathlib import Path

from kinjax.cli.cache import EXTRA, plain_fusions

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# two thirds of the time and half of the memory. (With no optimisation at all it would be a third, but what XLA then gives is wrong
# now and then: bodies at rest are seen to move)
os.environ.setdefault("XLA_FLAGS", f"{plain_fusions()} {EXTRA}xla_cpu_disable_loop_unrolling=true")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "programs"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
os.environ.setdefault("MPLBACKEND", "agg")

import jax
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
# tracing makes millions of small objects that live on: looking through them again and again is a twentieth of the time
gc.set_threshold(20_000, 50, 100)

DATA = Path(os.environ.get("KINJAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


@pytest.fixture(autouse=True, scope="module")
def compiled_programs_are_let_go():
    """Each compiled program holds memory maps, of which a process may have some 65,000: with those of all test files kept, XLA's
    compiler crashes."""
    yield
    jax.clear_caches()


@pytest.fixture
def x64():
    """float64 for one test; float32 is restored after it."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=["float32", "float64"])
def precision(request):
    """Runs a test once in float32 and once in float64, and gives the dtype's name."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real motion data beside the repository; a test that asks for it is skipped where there is none."""
    if not DATA.is_dir():
        pytest.skip(f"no motion data at {DATA} (set KINJAX_DATA)")
    return DATA
