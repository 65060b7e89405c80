import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Shapes and dtypes in annotations are checked at run time. This must be the package's first import.
with install_import_hook("nonholo_jax", "beartype.beartype"):
    import nonholo_jax  # noqa: F401


def pytest_configure(config):
    """Compiled programs are kept between runs and shared by the workers of xdist."""
    if hasattr(config, "cache"):  # absent under -p no:cacheprovider
        jax.config.update("jax_compilation_cache_dir", str(config.cache.mkdir("jax")))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Each compiled program holds memory maps, of which a process may have 65,530: let go of those of each file."""
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
