"""The compiled programs that the command line keeps between runs, so that only the first run of a kind compiles.

In: the environment. Out: JAX's persistent cache, set before the first computation; only the command line does this.
`KINJAX_CACHE` names another directory, or `off`; a directory that JAX was already told to use stays.
"""

from __future__ import annotations

import os
from importlib.metadata import version
from pathlib import Path

OFF = ("off", "0", "no", "none")
EXTRA = "--xla_backend_extra_options="
FAST_LOOPS = "xla_cpu_small_while_loop_byte_threshold=10000000"
"""One of XLA's extra options, of which all stand in one flag."""


def use_cache() -> Path | None:
    """Keep compiled programs in `cache_folder()`, and memory; gives the directory, or None where there is none."""
    import jax

    from ..memory import keep_memory

    keep_memory()
    told = jax.config.values["jax_compilation_cache_dir"]
    if told and not os.environ.get("KINJAX_CACHE", ""):
        return Path(told)
    folder = cache_folder()
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


def cache_folder() -> Path | None:
    """The user's directory of compiled programs, made if need be; None where it is switched off or cannot be written."""
    import platformdirs

    named = os.environ.get("KINJAX_CACHE", "")
    if named.lower() in OFF:
        return None
    folder = Path(named) if named else Path(platformdirs.user_cache_dir("kinjax"))
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None


def plain_fusions() -> str:
    """The flag that switches XLA's fusion emitters off: a deformation compiles in two thirds of the time and half of the memory,
    and runs as fast (detection would run slower). "" where the installed version may not know it: XLA ends the process then."""
    known = tuple(map(int, version("jaxlib").split(".")[:2])) <= (0, 10)
    return "--xla_cpu_use_fusion_emitters=false" if known else ""


def use_deform_flags() -> None:
    """Have XLA run small loops on the CPU in one thread each (the frame loop of a deformation is up to twice as fast), and
    compile with `plain_fusions`.

    XLA reads this once, so it goes before JAX. Only for commands that deform; what the user has set stays.
    """
    flags = os.environ.get("XLA_FLAGS", "").split()
    at = next((i for i, flag in enumerate(flags) if flag.startswith(EXTRA)), None)
    if at is None:
        flags.append(EXTRA + FAST_LOOPS)
    elif FAST_LOOPS.partition("=")[0] not in flags[at]:
        flags[at] += f",{FAST_LOOPS}"
    plain = plain_fusions()
    if plain and not any(flag.startswith(plain.partition("=")[0]) for flag in flags):
        flags.append(plain)
    os.environ["XLA_FLAGS"] = " ".join(flags)
