"""JAX's cache on disk, in which the command line keeps the programs that it has compiled. Never on in the library."""

import contextlib
import hashlib
import os
import platform
import sys
import warnings
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

MOST_BYTES = 256 * 2**20
_LEAST_SECONDS = 0.1  # what compiles faster than this is not kept
_VARIABLE = "NONHOLO_CACHE"
_OF_JAX = "(Error (reading|writing) persistent compilation cache entry|Cache value for key)"


def folder_of_programs() -> Path | None:
    """Where programs are kept; `None` where the environment says that they are not. Programs are those of one version
    of JAX for one kind of processor: a home may be shared by several machines."""
    import platformdirs

    chosen = os.environ.get(_VARIABLE, "")
    if chosen.lower() == "off":
        return None
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    kind = [line for line in lines if line.startswith(("model name", "flags", "Features"))][:2]
    processor = hashlib.sha256("\n".join([platform.machine(), platform.processor(), *kind]).encode()).hexdigest()[:8]
    own = Path(chosen) if chosen else Path(platformdirs.user_cache_dir("nonholo_jax", appauthor=False))
    return own / f"jax-{metadata.version('jax')}-{metadata.version('jaxlib')}-{processor}"


@contextlib.contextmanager
def programs_kept(wanted: bool) -> Iterator[None]:
    """Keep compiled programs on disk, and leave JAX as it was. A cache that JAX was given already stays as it is; one
    that cannot be used costs a line on standard error, no more. On processors only: nothing else was measured, unless
    `NONHOLO_CACHE` names a folder."""
    import jax

    folder = folder_of_programs() if wanted else None
    given = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is None or given or not (os.environ.get(_VARIABLE) or jax.default_backend() == "cpu"):
        yield
        return
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not os.access(folder, os.R_OK | os.W_OK | os.X_OK):
            raise PermissionError(13, "Permission denied")
    except (OSError, ValueError) as error:
        _complain(folder, getattr(error, "strerror", None) or error)
        yield
        return
    troubles: list[str] = []
    with _noted(folder, troubles), _configured(folder):
        yield
    if any(trouble.startswith("Error reading") for trouble in troubles):
        _emptied(folder)  # JAX never writes over what is there, and would stumble over it again


@contextlib.contextmanager
def _configured(folder: Path) -> Iterator[None]:
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    settings = {
        "jax_compilation_cache_dir": str(folder),
        "jax_compilation_cache_max_size": MOST_BYTES,
        "jax_persistent_cache_min_compile_time_secs": _LEAST_SECONDS,
    }
    before = {name: getattr(jax.config, name) for name in settings}
    try:
        compilation_cache.reset_cache()
        for name, value in settings.items():
            jax.config.update(name, value)
        yield
    finally:
        for name, value in before.items():
            jax.config.update(name, value)
        compilation_cache.reset_cache()


@contextlib.contextmanager
def _noted(folder: Path, troubles: list[str]) -> Iterator[None]:
    """Say in one line what JAX warns of, many times, where its cache fails; and let other warnings pass."""
    with warnings.catch_warnings():
        show = warnings.showwarning
        warnings.filterwarnings("always", message=_OF_JAX)

        def note(message: Any, category: Any, filename: str, lineno: int, file: Any = None, line: Any = None) -> None:
            text = str(message)
            if not text.startswith(("Error reading persistent", "Error writing persistent", "Cache value for key")):
                show(message, category, filename, lineno, file, line)
                return
            if not troubles:
                _complain(folder, text)
            troubles.append(text)

        warnings.showwarning = note
        yield


def _complain(folder: Path, reason: Any) -> None:
    what = f"compiled programs are not kept in {str(folder)!r} ({' '.join(str(reason).split())})"
    print(f"nonholo: {what}; empty it, or choose another by {_VARIABLE}, or --no-cache", file=sys.stderr, flush=True)


def _emptied(folder: Path) -> None:
    for path in (*folder.glob("*-cache"), *folder.glob("*-atime")):
        with contextlib.suppress(OSError):
            path.unlink()
