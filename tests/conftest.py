import gc
import os

import jax
import pytest
from jaxtyping import install_import_hook

# XLA's newer code generator for the CPU takes twice as long over these programs, which run no faster for it. Versions
# after 0.10 have no such choice, and stop at a flag that they do not know. What is set already counts: with
# XLA_FLAGS=--xla_cpu_use_fusion_emitters=true the tests run as users' programs do by default.
flags = ["--xla_cpu_use_fusion_emitters=false"] if jax.__version_info__ < (0, 11) else []
# The least effort of XLA: nearly every program here runs once, for milliseconds, and the library chooses it for single
# throws itself. To compile as batches do by default: XLA_FLAGS=--xla_backend_optimization_level=3
flags.append("--xla_backend_optimization_level=0")
os.environ["XLA_FLAGS"] = " ".join([*flags, os.environ.get("XLA_FLAGS", "")])
gc.set_threshold(100_000, 50, 50)  # programs are made of many objects that stay

os.environ["NONHOLO_CACHE"] = "off"  # no test writes to the cache of whoever runs it

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Shapes and dtypes in annotations are checked at run time, in every room but that of arithmetic, whose functions are
# called by the hundred thousand from checked ones. This must be the package's first import.
rooms = ("_impact", "_world", "_motion", "_questions", "_ensembles", "_files", "_pictures", "_cli")
with install_import_hook([f"nonholo_jax.{room}" for room in rooms], "beartype.beartype"):
    import nonholo_jax  # noqa: F401


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Let go of the programs of each file: hundreds of them stay in memory otherwise.

    Nor is JAX's cache on disk used: a worker was seen to crash while JAX 0.10 wrote a program to it. To have it all the
    same, when tests are run again and again, set JAX_COMPILATION_CACHE_DIR."""
    yield
    jax.clear_caches()


@pytest.fixture
def getkey():
    """`getkey()` is a new random key at every call, the same ones in every run."""
    key = jax.random.key(0)

    def _getkey():
        nonlocal key
        key, subkey = jax.random.split(key)
        return subkey

    return _getkey
